"""Fisheyes and mixed pairs rectified on the sphere; a fisheye cut into pinholes."""

import math

import pytest
import torch

from arraygeom import (
    Camera,
    Distortion,
    Pair,
    Pose,
    View,
    intrinsics,
    pixel_grid,
    resampled,
    rotation_from_vector,
)
from arraygeom.lenses import PolynomialFisheye
from arraygeom.wide_views import cube_faces, rectify_spherical
from tests.arraygeom.rigs import number

HW = (120, 160)


def fisheye(*, w=(0.0, 0.0, 0.0), centre=(0.0, 0.0, 0.0), focal=45.0) -> Camera:
    pose = Pose.from_centre(rotation_from_vector(number(*w)), number(*centre))
    lens = PolynomialFisheye(number(0.0, -0.02), number(1.9))
    return Camera(K=intrinsics(focal, HW), cam_from_world=pose, hw=HW, distortion=lens)


def pinhole() -> Camera:
    pose = Pose.from_centre(rotation_from_vector(number(0.1, -0.2, 0.05)), number(0.3, 0.1, 0.05))
    lens = Distortion("brown-conrady", number(-0.1, 0.0, 0.0, 0.0))
    return Camera(K=intrinsics(120.0, HW), cam_from_world=pose, hw=HW, distortion=lens)


@pytest.mark.parametrize(
    "beta", [fisheye(w=(0.1, -0.3, 0.2), centre=(0.4, 0.0, 0.1)), fisheye(centre=(0.02, 0.5, 0.1)), pinhole()]
)
def test_a_point_has_one_row_in_both(beta):
    """Upright, and all of both images is there; a baseline down the image, too."""
    old = Pair(fisheye(), beta, None)
    new = rectify_spherical(old)
    X = torch.randn(400, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 3
    before = [c.project(X) for c in old.cameras]
    seen = torch.stack([p.valid & c.contains(p.x) for p, c in zip(before, old.cameras)]).all(0)
    a, b = (c.project(X[seen]) for c in new.cameras)
    assert seen.sum() > 20
    torch.testing.assert_close(a.x[:, 1], b.x[:, 1], atol=1e-8, rtol=0)
    assert all(bool(c.contains(p.x).all()) for p, c in zip((a, b), new.cameras))
    up = new.cameras[0].project(old.cameras[0].unproject(number(79.5, 20.0), number(3.0)))
    down = new.cameras[0].project(old.cameras[0].unproject(number(79.5, 99.0), number(3.0)))
    sideways = abs(float(old.beta_from_alpha.t[1])) > 0.4
    assert sideways or float(down.x[1] - up.x[1]) > 40


def test_an_image_follows():
    """A smooth image of directions, seen by the old camera, is what the new camera sees."""
    old = Pair(fisheye(), pinhole(), None)
    new = rectify_spherical(old)
    images = []
    for camera in (old.cameras[0], new.cameras[0]):
        rays, valid = camera.rays(pixel_grid(camera.hw, dtype=torch.float64))
        directions = rays @ camera.R
        image = (directions / directions.norm(dim=-1, keepdim=True)).movedim(-1, 0)
        images.append((torch.where(valid, image, 0.0), valid))
    found = resampled(images[0][0], old.cameras[0], new.cameras[0])
    both = found.valid[0] & images[1][1]
    assert both.double().mean() > 0.4
    assert float((found.values[0] - images[1][0])[:, both].abs().median()) < 1e-3


def test_faces_see_what_the_fisheye_sees():
    camera = fisheye()
    faces = cube_faces(camera)
    assert next(iter(faces)) == "front"
    assert set(faces) >= {"front", "left", "right"}
    assert "back" not in faces
    X = torch.randn(500, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    there = camera.project(X)
    seen = there.valid & camera.contains(there.x)
    by_face = torch.stack([f.contains(f.project(X).x) & f.project(X).valid for f in faces.values()])
    assert bool(by_face.any(0)[seen].all())
    assert float(faces["right"].project(number(3.0, 0.0, 0.0)).x[0]) == pytest.approx(
        (faces["right"].hw[1] - 1) / 2
    )
    assert float(faces["up"].project(number(0.0, -3.0, 0.0)).depth) == pytest.approx(3.0)
    assert math.degrees(math.atan(faces["front"].hw[1] / 2 / float(faces["front"].K[0, 0]))) > 45


def test_what_cannot_be_rectified_is_refused():
    with pytest.raises(ValueError, match="baseline"):
        rectify_spherical(Pair(fisheye(), fisheye(), None))
    with pytest.raises(ValueError, match="calibrated"):
        rectify_spherical(Pair(View(hw=HW), View(hw=HW)))
