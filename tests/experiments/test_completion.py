"""What the completion learns from: pairs of photographs, what is kept of them, and a step of training."""

import numpy as np
import pytest
import torch

from experiments.completion.capture import PLANES, levels, values
from experiments.completion.pairs import photo_pair
from experiments.completion.training import CompletionTraining, train_completion, varied
from pat.media.colour import from_luma_chroma
from pat.networks.weights import load_weights


def planes_of(*shape):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(0)) * 0.4


def test_all_that_is_drawn_depends_on_the_seed(photos):
    one, same, other = (photo_pair(photos / "coffee.png", photos / "astronaut.png", s) for s in (1, 1, 2))
    assert torch.equal(one.right, same.right)
    assert not torch.equal(one.right, other.right)


def test_planes_are_kept_as_bytes():
    planes = planes_of(PLANES, 48, 64)
    torch.testing.assert_close(values(levels(planes)), planes, atol=0.003, rtol=0)


def test_another_hue_has_errors_as_large_in_rgb():
    """But for saturation, which changes all of a frame's colours by one factor."""
    planes, g = planes_of(8, PLANES, 6, 6), torch.Generator().manual_seed(1)
    changed = varied(planes, g)

    def energy(x):
        colours = x[:, 2:].unflatten(1, (-1, 2))
        return from_luma_chroma(0 * colours[:, :, :1], colours).square().sum((2, 3, 4))

    ratio = energy(changed) / energy(planes)
    torch.testing.assert_close(ratio, ratio[:, :1].expand_as(ratio), rtol=1e-4, atol=0)
    assert float(ratio.std()) > 0.01


def test_a_photograph_must_be_one(tmp_path):
    (tmp_path / "a.png").write_bytes(b"none")
    with pytest.raises(ValueError, match="not an image"):
        photo_pair(tmp_path / "a.png", tmp_path / "a.png", 0)
    with pytest.raises(ValueError, match="no photograph"):
        train_completion(CompletionTraining(photos=(tmp_path / "empty",), out=tmp_path / "out"))


@pytest.mark.slow
def test_a_completion_is_captured_and_trained(photos, tmp_path):
    config = CompletionTraining(
        photos=(photos,),
        out=tmp_path / "out",
        captured=2,
        widths=(4, 4, 4),
        steps=2,
        batch=2,
        side=64,
    )
    made = load_weights(train_completion(config))
    assert made.config.completion == (4, 4, 4)
    assert np.isfinite(float(made.completion.unet.last.weight.sum()))
