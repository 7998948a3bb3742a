"""An alpha in colour keeps its own colours where the betas say nothing."""

import pytest
import torch

from pat import FuseSettings, fuse
from pat.app.sample_array import load_sample
from pat.fusion.frame import Frame
from pat.fusion.luminance import with_own_colours
from pat.media.colour import from_luma_chroma, luminance, to_luma_chroma
from pat.networks.weights import load_weights


def test_chroma_is_alphas_own_as_the_betas_show_it_and_luminance_stays():
    torch.manual_seed(0)
    truth = torch.rand(3, 40, 60)
    luma, chroma = to_luma_chroma(truth)
    rendered = from_luma_chroma(luma, 0.8 * chroma)  # a paler camera
    confidence = torch.ones(40, 60)
    confidence[:, 30:] = 0.0
    wrong = rendered.clone()
    wrong[:, :, 30:] = from_luma_chroma(luma, -chroma)[:, :, 30:]
    mended = with_own_colours(Frame(wrong, torch.ones(40, 60), confidence, torch.ones(40, 60)), truth).image
    assert torch.allclose(mended, rendered, atol=1e-2)
    assert torch.allclose(luminance(mended), luma, atol=1e-5)
    grey = with_own_colours(Frame(wrong, *torch.ones(1, 40, 60), *torch.zeros(2, 40, 60)), truth).image
    assert torch.allclose(grey, truth, atol=1e-4)


@pytest.mark.parametrize("in_colour", [True, False])
def test_what_no_beta_sees_has_alphas_colours(in_colour):
    """The beta shows the left part alone; the right is not coloured by extrapolation."""
    sample = load_sample()
    half = tuple(n // 2 for n in sample.rig["mono"].hw)
    rig = sample.rig.resize("mono", half).resize("colour", (180, 280))
    alpha = torch.nn.functional.avg_pool2d(sample.ground_truth, 2)
    beta = torch.nn.functional.avg_pool2d(sample.images["colour"], 2)[..., :110]
    rig = rig.with_camera("colour", rig["colour"].crop(0, 0, (180, 110)))
    with pytest.warns(UserWarning, match="colour") if in_colour else torch.no_grad():
        images = {"mono": alpha if in_colour else luminance(alpha), "colour": beta}
        frame = fuse(
            images,
            rig,
            alpha="mono",
            network=load_weights("mono-colour"),
            settings=FuseSettings(align=False, response="rec601"),
        )
    unseen = frame.confidence < 0.1
    assert 0.2 < float(unseen.float().mean()) < 0.9
    off = float((frame.image - alpha).abs().mean(0)[unseen].mean())
    assert off < 0.0065 if in_colour else off > 0.01
