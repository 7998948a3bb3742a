import dataclasses

import pytest
import torch

from arraygeom.camera import View, intrinsics
from arraygeom.distortion import KANNALA_BRANDT, Distortion
from arraygeom.lenses import Orthographic
from arraygeom.pixels import pixel_grid
from arraygeom.pose import Pose
from pat.lab.synthesis.blender.lens import lens_for
from tests.pat.lab.synthesis.scenes import unlike_cameras

RIG = unlike_cameras()
NORMAL, D = torch.tensor([0.2, -0.3, 1.0], dtype=torch.float64), 5.0


def plane_depth(camera):
    """Depth of the plane n . X = d at every pixel, along the camera's own rays."""
    x = pixel_grid(camera.hw, dtype=torch.float64)
    rays = camera.unproject(x, torch.ones(camera.hw, dtype=torch.float64)) - camera.centre
    return (D - NORMAL @ camera.centre) / (rays @ NORMAL)


@pytest.mark.parametrize("name", ["oblong", "shifted", "turned"])
def test_a_pinhole_is_rendered_as_it_is_brought_upright(name):
    camera, lens = RIG[name], lens_for(RIG[name], name)
    X = torch.randn(50, 3, dtype=torch.float64) + torch.tensor([0, 0, 5.0])
    torch.testing.assert_close(lens.pinhole.project(X).x, camera.project(X).x)
    torch.testing.assert_close(lens.pinhole.project(X).depth, camera.project(X).depth)
    K = lens.pinhole.K
    assert K[0, 1] == K[1, 0] == 0
    assert K[0, 0] > 0 < K[1, 1]
    image = torch.rand(3, *camera.hw)
    assert lens.resampled(image) is image


@pytest.mark.parametrize("model", ["distorted", "fisheye"])
def test_a_lens_is_resampled_from_a_pinhole_that_covers_it(model):
    camera = RIG["distorted"]
    if model == "fisheye":
        coefficients = torch.tensor([-0.02, 0.004, -0.001, 0.0002], dtype=torch.float64)
        camera = camera.replace(
            distortion=Distortion(KANNALA_BRANDT, coefficients), K=intrinsics(35.0, camera.hw)
        )
    lens = lens_for(camera, "c")
    h, w = lens.pinhole.hw
    assert lens.valid.all()
    assert ((lens.x >= 1) & (lens.x <= torch.tensor([w - 2, h - 2]))).all()
    depth = plane_depth(lens.pinhole)
    index = torch.ones(h, w, dtype=torch.int32)
    torch.testing.assert_close(lens.depth(depth, index), plane_depth(camera), rtol=1e-6, atol=0)
    directions = pixel_grid(lens.pinhole.hw, dtype=torch.float64).movedim(-1, 0)
    torch.testing.assert_close(lens.resampled(directions), lens.x.movedim(-1, 0), rtol=0, atol=5e-3)


def test_depth_across_edges_is_of_one_side():
    lens = lens_for(RIG["distorted"], "distorted")
    h, w = lens.pinhole.hw
    left = torch.arange(w).expand(h, w) < w // 2
    depth = torch.where(left, 2.0, 5.0)
    for index in (left.int() + 1, torch.ones(h, w, dtype=torch.int32)):
        assert set(lens.depth(depth, index).double().round(decimals=6).unique().tolist()) == {2.0, 5.0}
        assert set(lens.nearest(depth[None]).unique().tolist()) == {2.0, 5.0}


def test_what_the_lens_cannot_see_is_marked():
    folding = dataclasses.replace(
        RIG["distorted"].distortion, coefficients=torch.tensor([-1.0, 0, 0, 0]).double()
    )
    lens = lens_for(RIG["distorted"].replace(distortion=folding), "distorted")
    assert not lens.valid.all()
    depth = lens.depth(torch.full(lens.pinhole.hw, 3.0), torch.ones(lens.pinhole.hw, dtype=torch.int32))
    assert (depth.isnan() == ~lens.valid).all()
    assert (lens.resampled(torch.ones(3, *lens.pinhole.hw))[:, ~lens.valid] == 0).all()


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        (
            RIG["oblong"].replace(K=RIG["oblong"].K + torch.tensor([[0, 0.5, 0], [0, 0, 0], [0, 0, 0]])),
            "skew",
        ),
        (RIG["oblong"].replace(K=RIG["oblong"].K * torch.tensor([[-1.0], [1], [1]])), "mirrors"),
        (View(hw=(48, 64)), "calibrated"),
        (RIG["distorted"].replace(K=RIG["distorted"].K[None]), "batched"),
        (
            RIG["oblong"].replace(cam_from_world=Pose(torch.eye(3).expand(2, 3, 3), torch.zeros(2, 3))),
            "batched",
        ),
        (RIG["oblong"].replace(distortion=Orthographic()), "meet"),
        (
            RIG["distorted"].replace(
                K=intrinsics(20.0, (48, 64)), distortion=Distortion(KANNALA_BRANDT, torch.zeros(4).double())
            ),
            "degrees",
        ),
    ],
)
def test_what_cannot_be_rendered_is_said(camera, said):
    with pytest.raises(ValueError, match=f"camera 'odd'.* {said}"):
        lens_for(camera, "odd")
