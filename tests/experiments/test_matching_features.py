"""Features for matching: words of bits, contrasts that no exposure changes, parts equal to the whole."""

import numpy as np
import pytest
import torch

from experiments.learned_matching.features import (
    BITS,
    FeatureConfig,
    MatchingEncoder,
    SizeEncoder,
    comparisons,
    contrasts,
    load_features,
    save_features,
    words,
)
from pat.matching.cost import census

SHARP = torch.zeros(1)


def moved(encoder: MatchingEncoder) -> MatchingEncoder:
    """The encoder with all weights moved at random, as training does."""
    torch.manual_seed(0)
    encoder.requires_grad_(False)
    for parameter in encoder.parameters():
        parameter += 0.1 * torch.randn_like(parameter)
    return encoder


@pytest.fixture(scope="module")
def image():
    return torch.rand(1, 1, 64, 96, generator=torch.Generator().manual_seed(3))


@pytest.fixture(scope="module")
def encoder():
    return moved(MatchingEncoder().eval())


def test_words_hold_the_signs():
    features = torch.randn(2, BITS, 3, 5)
    found = words(features)
    bits = (found[..., None] >> np.arange(BITS, dtype=np.uint64)) & np.uint64(1)
    assert found.shape == (2, 3, 5)
    assert found.dtype == np.uint64
    assert (bits.astype(bool) == (features > 0).movedim(1, -1).numpy()).all()


def test_contrast_is_that_of_any_exposure(image):
    soft = torch.nn.functional.avg_pool2d(image, 5, 1, 2)
    found, darker = contrasts(soft), contrasts(0.7 * soft + 0.1)
    assert (found[:, 1:] - darker[:, 1:]).abs().max() < 0.25
    assert (found[:, 1:] - darker[:, 1:]).abs().mean() < 0.02
    assert (found[:, :1] - darker[:, :1]).abs().mean() > 0.03


def test_contrast_of_nothing_is_none():
    assert contrasts(torch.full((1, 1, 16, 16), 0.5)).abs().max() < 1e-3


@pytest.mark.parametrize("size", ["full", "half"])
@pytest.mark.parametrize("view", ["alpha", "beta"])
def test_before_training_the_first_bits_are_those_of_census(image, view, size):
    image = (image * 255).round() / 255
    expected = np.empty(image.shape[2:], np.uint64)
    census(image[0, 0].numpy(), expected)
    found = words(MatchingEncoder()(image, view, size, SHARP))[0]
    bits = [(found >> np.uint64(i)) & np.uint64(1) for i in range(48)]
    assert (sum(b << np.uint64(47 - i) for i, b in enumerate(bits)) == expected).all()


def test_the_other_comparisons_are_of_unlike_means_too():
    found = comparisons()
    assert found.sum((1, 2)).abs().max() < 1e-6
    assert len({tuple(f.flatten().tolist()) for f in found}) == BITS


def test_of_several_images_each_is_for_itself(encoder, image):
    blur = torch.tensor([0.0, 2.0])
    both = encoder(torch.cat([image, image.flip(-1)]), "beta", "full", blur)
    assert torch.allclose(both[:1], encoder(image, "beta", "full", SHARP), atol=1e-4)


def test_blur_changes_what_is_compared(encoder, image):
    assert not torch.equal(encoder(image, "beta", "full", SHARP), encoder(image, "beta", "full", SHARP + 2))


def test_parts_with_a_halo_are_those_of_the_whole(encoder, image):
    whole, part = (encoder(x, "alpha", "full", SHARP) for x in (image, image[..., 16:]))
    halo = SizeEncoder.halo
    assert torch.allclose(whole[..., 16 + halo :], part[..., halo:], atol=1e-4)
    assert not torch.allclose(whole[..., 16 + halo - 1 :], part[..., halo - 1 :], atol=1e-4)


def test_a_file_gives_back_the_encoder(tmp_path, image):
    made = moved(MatchingEncoder(FeatureConfig(width=4)).eval())
    save_features(made, tmp_path / "features.safetensors", {"recipe": "none"})
    found = load_features(tmp_path / "features.safetensors")
    assert found.config == made.config
    assert torch.equal(found(image, "beta", "half", SHARP), made(image, "beta", "half", SHARP))


def test_another_file_is_named(tmp_path):
    (tmp_path / "features.safetensors").write_bytes(b"no weights")
    with pytest.raises(ValueError, match=r"features\.safetensors"):
        load_features(tmp_path / "features.safetensors")
    with pytest.raises(FileNotFoundError, match="absent"):
        load_features(tmp_path / "absent.safetensors")
