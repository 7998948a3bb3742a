"""Whose brightness the fused image has."""

import pytest
import torch

from pat import FuseSettings, fuse
from pat.media.colour import luminance
from pat.networks.weights import load_weights
from tests.pat.layered_array import ALPHA, middle_of_sample


@pytest.fixture(scope="module")
def sample():
    return middle_of_sample()


@pytest.fixture(scope="module")
def images(sample):
    """Alpha sees another part of the spectrum than the eye does: red and a little blue."""
    seen = (sample.ground_truth * torch.tensor([0.8, 0.0, 0.2])[:, None, None]).sum(0, keepdim=True)
    return dict(sample.images) | {ALPHA: seen}


@pytest.fixture(scope="module")
def fused(sample, images):
    network = load_weights("mono-colour")

    def frame(kept):
        return fuse(
            images,
            sample.rig,
            alpha=ALPHA,
            network=network,
            settings=FuseSettings(response="rec601", align=False, luminance=kept),
        )

    return {kept: frame(kept) for kept in ("alpha", "mix", "beta")}


def test_the_luminance_is_whose_is_asked_for(sample, images, fused):
    luma = {kept: luminance(frame.image) for kept, frame in fused.items()}
    torch.testing.assert_close(luma["alpha"], images[ALPHA], atol=1e-5, rtol=0)
    wanted = luminance(sample.ground_truth)
    seen = fused["beta"].confidence > 0.8
    errors = {kept: float((one - wanted)[0][seen].abs().mean()) for kept, one in luma.items()}
    assert errors["beta"] < 0.55 * errors["alpha"]
    assert errors["beta"] < errors["mix"] < errors["alpha"]


def test_betas_luminance_has_alphas_detail(sample, fused, monkeypatch):
    """The colour camera of the sample has about half of alpha's resolution."""
    from pat.fusion import fuse as module

    monkeypatch.setattr(module, "with_alpha_detail", lambda frame, alpha: frame)
    images = dict(sample.images) | {ALPHA: luminance(sample.ground_truth)}
    network = load_weights("mono-colour")
    options = {"alpha": ALPHA, "network": network}
    options["settings"] = FuseSettings(response="rec601", align=False, luminance="beta")
    plain = fuse(images, sample.rig, **options)
    monkeypatch.undo()
    detailed = fuse(images, sample.rig, **options)
    seen = detailed.confidence > 0.8

    def fine(image):
        luma = luminance(image)
        return (luma - torch.nn.functional.avg_pool2d(luma, 5, 1, 2))[0][seen]

    wanted = fine(sample.ground_truth)
    before, after = (float((fine(f.image) - wanted).square().mean()) for f in (plain, detailed))
    assert after < 0.7 * before


@pytest.mark.parametrize(
    ("weights", "options", "message"),
    [
        ("mono-spectral", {"luminance": "beta"}, "RGB"),
        ("mono-colour", {"luminance": "mix", "noise": "estimate"}, "noise"),
    ],
)
def test_what_cannot_be_is_refused(sample, weights, options, message):
    with pytest.raises(ValueError, match=message):
        fuse(
            sample.images,
            sample.rig,
            alpha=ALPHA,
            network=load_weights(weights),
            settings=FuseSettings(**options),
        )
