"""Pinhole views: OpenCV's maps as oracle, there and back is the image, nothing of the view left out."""

import math

import numpy as np
import pytest
import torch

from arraygeom import (
    Camera,
    Distortion,
    LensView,
    Pose,
    intrinsics,
    pinhole_view,
    resampled,
    rotation_from_vector,
)
from arraygeom.undistortion import WIDEST, pixels_between
from tests.oracles import Oracle

cv2 = Oracle("cv2")

HW = (120, 160)
LENSES = {"brown-conrady": [-0.36, 0.17, 0.001, -0.002], "kannala-brandt": [-0.02, 0.01, -0.003, 0.001]}


def camera(model, focal=110.0):
    lens = Distortion(model, torch.tensor(LENSES[model], dtype=torch.float64))
    K = intrinsics((focal, focal * 1.02), HW, (81.0, 58.0))
    pose = Pose(
        rotation_from_vector(torch.tensor([0.1, 0.3, -0.2]).double()), torch.tensor([0.2, 0, 1]).double()
    )
    return Camera(K=K, cam_from_world=pose, hw=HW, distortion=lens)


def image(hw, period=20.0):
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in hw), indexing="ij")
    return torch.stack([0.5 + 0.4 * torch.sin(x / period * 2), 0.5 + 0.4 * torch.cos((x + y) / period)])


@pytest.mark.parametrize("model", LENSES)
def test_pixels_are_where_opencv_has_them(model):
    c = camera(model)
    view = pinhole_view(c)
    K, D, new = c.K.numpy(), c.distortion.coefficients.numpy(), view.K.numpy()
    maps = cv2.fisheye.initUndistortRectifyMap if model == "kannala-brandt" else cv2.initUndistortRectifyMap
    theirs = np.stack(maps(K, D, np.eye(3), new, view.hw[::-1], cv2.CV_32FC1), -1)
    x, seen = pixels_between(c, view)
    assert seen.float().mean() > 0.7
    assert np.abs(theirs - x.numpy())[seen].max() < 2e-4


@pytest.mark.parametrize("model", LENSES)
def test_there_and_back_is_the_image(model):
    c = camera(model)
    view = pinhole_view(c)
    there = resampled(image(HW), c, view)
    back = resampled(there.values[0], view, c)
    inside = back.valid[0, 4:-4, 4:-4]
    assert inside.float().mean() > 0.95
    assert (back.values[0] - image(HW))[:, 4:-4, 4:-4].abs()[:, inside].max() < 0.01


def test_all_is_kept_up_to_the_widest_angle_and_the_middle_keeps_its_size():
    c = camera("kannala-brandt", focal=55.0)
    view = pinhole_view(c)
    rays, valid = c.rays(torch.tensor([[0.0, 58.0], [159.0, 58.0], [81.0, 10.0], [81.0, 106.0]]).double())
    assert valid.all()
    angle = torch.atan2(rays[:, :2].norm(dim=-1), rays[:, 2])
    assert angle[0] > WIDEST > angle[2]
    x = rays[2:, :2] / rays[2:, 2:] @ view.K[:2, :2].T + view.K[:2, 2]
    assert view.contains(x).all()
    assert torch.equal(view.K[:2, :2], c.K[:2, :2])
    assert view.hw[1] < 2 * 55 * math.tan(WIDEST) + 3


def test_a_rotated_co_located_camera_sees_a_rotated_image():
    c = camera("brown-conrady")
    turned = c.replace(K=c.K, cam_from_world=Pose(torch.eye(3).double(), c.t), distortion=None)
    X = c.cam_from_world.inverse().apply(torch.tensor([[0.1, -0.2, 3.0]]).double())
    looked = turned.replace(cam_from_world=Pose.from_centre(torch.eye(3).double(), c.centre))
    x, seen = pixels_between(c, looked.replace(hw=(400, 400)))
    there = looked.project(X).x[0].round().long()
    assert seen[there[1], there[0]]
    assert (x[there[1], there[0]] - c.project(X).x[0]).abs().max() < 1.0


def test_one_camera_at_a_time():
    c = camera("brown-conrady")
    with pytest.raises(ValueError, match="camera"):
        pinhole_view(c.replace(K=c.K[None], cam_from_world=Pose(c.R[None], c.t[None])))


def test_a_image_extended_keeps_its_edge_where_nothing_is_seen():
    c = camera("brown-conrady")
    view = pinhole_view(c)
    plain, extended = (resampled(image(HW), c, view, extended=e) for e in (False, True))
    assert torch.equal(plain.valid, extended.valid)
    assert torch.equal(extended.values * extended.valid, plain.values)
    assert (extended.values > 0).all()
    for row, column in ((0, 0), (-1, -1)):
        assert not plain.valid[0, row, column]
        corner = image(HW)[:, row, column]
        assert torch.allclose(extended.values[0, :, row, column], corner, atol=1e-3)


def test_a_lens_of_unknown_focal_length_bends_as_that_of_a_camera():
    c = camera("brown-conrady")
    view = LensView(hw=c.hw, K=c.K, distortion=c.distortion)
    pinhole, of_view = pinhole_view(c), pinhole_view(view)
    assert of_view.hw == pinhole.hw
    seen = resampled(image(HW), view, of_view).valid
    theirs, ours = pixels_between(c, pinhole)[0], pixels_between(view, of_view)[0]
    assert torch.allclose(theirs[seen[0]], ours[seen[0]])
    assert seen.float().mean() > 0.7
    x = torch.tensor([[10.0, 20.0], [150.0, 100.0]], dtype=torch.float64)
    rays, _ = c.rays(x)
    straight, valid = view.undistort(x)
    assert valid.all()
    assert torch.allclose(straight, c.replace(distortion=None).project_local(rays).x)
    assert torch.allclose(view.distort(straight)[0], x)
