"""Cameras as other libraries' tensors, by those libraries' own formulas."""

import pytest
import torch

from arraygeom import Camera
from arraygeom.io import tensors
from tests.arraygeom.rigs import BARREL, random_rig

CAMERA = random_rig(3)["beta"]
assert isinstance(CAMERA, Camera)
POINTS = CAMERA.unproject(
    torch.tensor([[3.0, 4.0], [50.2, 20.5], [30.0, 39.0]]).double(), torch.tensor([2.0, 3, 4])
)
PIXELS = CAMERA.project(POINTS).x
SKEWED = CAMERA.replace(K=CAMERA.K + torch.tensor([[0, 2.0, 0], [0, 0, 0], [0, 0, 0]]))


def homogeneous(X):
    return torch.nn.functional.pad(X, (0, 1), value=1.0)


@pytest.mark.parametrize("camera", [CAMERA, SKEWED])
def test_gsplat(camera):
    """Its pixel (i, j) has its centre at (i + 0.5, j + 0.5)."""
    viewmats, Ks = tensors.to_gsplat(camera)
    x = (homogeneous(POINTS) @ viewmats.T)[:, :3] @ Ks.T
    torch.testing.assert_close(x[:, :2] / x[:, 2:] - 0.5, camera.project(POINTS).x)
    same(tensors.from_gsplat(viewmats, Ks, camera.hw), camera)


@pytest.mark.parametrize("camera", [CAMERA, SKEWED])
def test_opengl(camera):
    """Normalised device coordinates -1 and 1 are the image's edges, y up; depths -1 near and 1 far."""
    view, projection = tensors.to_opengl(camera, 0.5, 20.0)
    clip = homogeneous(POINTS) @ (projection @ view).T
    ndc = clip[:, :3] / clip[:, 3:]
    h, w = camera.hw
    x = torch.stack([(ndc[:, 0] + 1) * w / 2, (1 - ndc[:, 1]) * h / 2], -1) - 0.5
    torch.testing.assert_close(x, camera.project(POINTS).x)
    for depth, expected in ((0.5, -1.0), (20.0, 1.0)):
        X = camera.unproject(PIXELS[:1], torch.tensor([depth]).double())
        clip = homogeneous(X) @ (projection @ view).T
        assert float(clip[0, 2] / clip[0, 3]) == pytest.approx(expected)
    same(tensors.from_opengl(view, projection, camera.hw), camera)


def test_pytorch3d():
    """Screen coordinates of its cameras: x = cx - fx X / Z, y = cy - fy Y / Z for X left and Y up."""
    given = tensors.to_pytorch3d(CAMERA)
    X = POINTS @ given.R + given.T
    x = given.principal_point - given.focal_length * X[:, :2] / X[:, 2:]
    torch.testing.assert_close(x - 0.5, PIXELS)
    same(tensors.from_pytorch3d(given), CAMERA)


def same(found: Camera, camera: Camera) -> None:
    torch.testing.assert_close(found.K, camera.K)
    torch.testing.assert_close(found.R, camera.R)
    torch.testing.assert_close(found.t, camera.t)
    assert found.hw == camera.hw


def test_what_they_cannot_hold_is_refused():
    with pytest.raises(ValueError, match="lens"):
        tensors.to_gsplat(CAMERA.replace(distortion=BARREL))
    with pytest.raises(ValueError, match="skewed"):
        tensors.to_pytorch3d(SKEWED)
    for far in (1.0, float("inf")):
        with pytest.raises(ValueError, match="near"):
            tensors.to_opengl(CAMERA, 2.0, far)
