"""Images warped to rows and back: the canvas holds alpha, depth comes back exactly, failures are said."""

import pytest
import torch

from arraygeom import Epipolar, apply_homography, pixel_grid
from arraygeom.epipolar import epipolar_distance
from experiments.evaluation.sweeps import ALPHA, BETA, Directly, made, point
from pat.lab.evaluation.ablation import sample_photographs
from pat.lab.evaluation.rectified import rectified
from pat.networks.configs import PATConfig
from pat.networks.paper import PAT

HW = (48, 64)


def level(rig):
    return rectified(rig, {name: torch.zeros(3, *HW) for name in rig.names})


@pytest.mark.parametrize(("sweep", "value"), [("focal ratio", 1), ("focal ratio", 3), ("ahead", 30)])
def test_the_canvas_holds_all_of_alpha_at_its_scale(sweep, value):
    found = level(point(sweep, value, hw=HW).rig).rectification
    x = apply_homography(found.H_alpha, pixel_grid(HW, dtype=torch.float64)).x
    assert bool(found.pair.alpha.contains(x).all())
    step = (x[:, 1:] - x[:, :-1]).norm(dim=-1)
    assert float(step.median()) == pytest.approx(1.33 if sweep == "ahead" else 1, abs=0.05)


def test_the_depth_of_a_slanted_plane_comes_back():
    rig = point("ahead", 30, hw=HW).rig
    normal = torch.tensor([0.2, -0.1, 1.0], dtype=torch.float64)

    def depth(camera):
        rays, _ = camera.rays(pixel_grid(camera.hw, dtype=torch.float64))
        return (4 - camera.centre @ normal) / ((rays @ camera.R) @ normal)

    canvas = level(rig)
    found = canvas.depth_back(depth(canvas.rectification.pair.cameras[0]))
    assert float((found / depth(rig[ALPHA]) - 1).abs().max()) < 0.02  # the nearest pixel's


@pytest.mark.parametrize("ratio", [1, 2])
def test_positions_are_those_of_beta_as_recorded(ratio):
    """Neither the border around beta nor its new size moves what is found off its line."""
    torch.manual_seed(0)
    network = PAT(PATConfig(dim=4, interpolation="bilinear", normalised=True)).eval().requires_grad_(False)
    rig = point("focal ratio", ratio, hw=HW).rig
    scene = made(rig, sample_photographs(count=2), 0)
    found = Directly(Epipolar()).fuse(network, rig, scene.images).peak
    off = epipolar_distance(rig.pair(ALPHA, BETA).fundamental, pixel_grid(HW, dtype=torch.float64), found[0])
    assert off.abs().median() < 1e-3


@pytest.mark.parametrize("degrees", [60, 90])
def test_a_camera_nearly_ahead_is_refused(degrees):
    with pytest.raises(ValueError, match="baseline"):
        level(point("ahead", degrees, hw=HW).rig)


def test_an_image_that_is_missing_is_said():
    rig = point("focal ratio", 1, hw=HW).rig
    with pytest.raises(ValueError, match=ALPHA):
        rectified(rig, {ALPHA: torch.zeros(3, *HW)})
