"""Matched points and quantities derived from them, against known rigs."""

import cv2
import numpy as np
import pytest
import torch

from arraygeom import Camera, Pose, Rig, apply_homography, epipolar_lines, intrinsics, rotation_from_vector
from calib.images import matches
from calib.images.matches import (
    ENOUGH,
    PointMatches,
    fit_link,
    line_distance,
    match_points,
    near_lines,
    seen_depths,
)
from tests.calib.scenes import texture

HW = (240, 320)


def rig_of(depth=(1.0, 9.0)) -> Rig:
    R = rotation_from_vector(torch.tensor([0.01, -0.03, 0.05], dtype=torch.float64))
    t = torch.tensor([-0.2, 0.03, 0.02], dtype=torch.float64)
    cameras = {
        "left": Camera(K=intrinsics(300.0, HW), cam_from_world=Pose.from_centre(R, R.T @ t + 3), hw=HW),
        "right": Camera(K=intrinsics(250.0, HW), cam_from_world=Pose(R.T, t), hw=HW),
    }
    return Rig(cameras, depth=depth)


def seen_points(rig, *, count=300, near=2.0, far=6.0, noise=0.0):
    """Matches of random points between two depths in front of left, good to `noise` pixels."""
    g = torch.Generator().manual_seed(0)
    left, right = rig["left"], rig["right"]
    x = torch.rand(count, 2, generator=g, dtype=torch.float64) * torch.tensor([319.0, 239.0])
    depth = near + (far - near) * torch.rand(count, generator=g, dtype=torch.float64)
    y = right.project(left.unproject(x, depth)).x
    return PointMatches(x, y + noise * torch.randn(count, 2, generator=g, dtype=torch.float64))


def test_matches_follow_a_known_map():
    H = np.array([[0.8, 0.05, 20.0], [-0.05, 0.8, 30.0], [0, 0, 1.0]])
    image = texture()
    moved = torch.from_numpy(cv2.warpPerspective(image[0].numpy(), H, (300, 220), flags=cv2.INTER_AREA))[None]
    matches = match_points(image, 0.3 + 0.5 * moved)
    assert len(matches.alpha) > 50
    off = apply_homography(torch.from_numpy(H), matches.alpha).x - matches.beta
    assert off.norm(dim=-1).median() < 0.5
    assert off.mean(0).abs().max() < 0.15


def test_flat_images_have_no_matches():
    assert len(match_points(torch.full((1, 60, 60), 0.5), texture()).alpha) == 0


def test_lines_choose_matches():
    rig = rig_of()
    F, matches = rig.pair("left", "right").fundamental, seen_points(rig)
    assert line_distance(matches, F).max() < 1e-6
    wrong = PointMatches(matches.alpha, matches.beta.flip(0))
    both = PointMatches(torch.cat([matches.alpha, wrong.alpha]), torch.cat([matches.beta, wrong.beta]))
    assert 300 <= len(near_lines(both, F, within=1).alpha) < 330


def test_a_link_is_refined_and_its_map_reaches_the_points():
    rig = rig_of()
    F, matches = rig.pair("left", "right").fundamental, seen_points(rig, noise=0.2)
    shift = torch.tensor([[1.0, 0, 2.0], [0, 1, -2.0], [0, 0, 1]], dtype=torch.float64)
    off = torch.linalg.inv(shift).T @ F
    assert line_distance(matches, off).median() > 1
    fit = fit_link(matches, off)
    exact = seen_points(rig)
    assert line_distance(exact, fit.link.F).median() < 0.2
    away = exact.beta - apply_homography(fit.link.H, exact.alpha).x
    assert (away.norm(dim=-1) < fit.displacement + 3).double().mean() > 0.9
    line = epipolar_lines(fit.link.F, exact.alpha)
    along = (away * torch.stack([line[:, 1], -line[:, 0]], -1)).sum(-1)
    assert fit.displacement < 0.55 * (along.max() - along.min())


def test_a_link_needs_points_that_agree():
    rig = rig_of()
    matches = seen_points(rig)
    other = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, -500]], dtype=torch.float64)
    with pytest.raises(ValueError):
        fit_link(matches, other)


def test_depths_contain_the_matched_points():
    rig = rig_of()
    near, far = seen_depths(rig.pair("left", "right"), seen_points(rig, noise=0.1))
    assert 1.7 < near < 2.0
    assert 6.0 < far < 7.6


def test_depths_need_points_that_fit():
    rig = rig_of()
    few = seen_points(rig, count=ENOUGH - 1)
    with pytest.raises(ValueError, match=str(ENOUGH - 1)):
        seen_depths(rig.pair("left", "right"), few)


def test_features_are_matched_as_by_opencv():
    rng = np.random.default_rng(0)
    b = rng.integers(0, 256, (700, 128)).astype(np.float32)
    a = np.concatenate([b[rng.permutation(700)[:300]] + rng.integers(-30, 30, (300, 128)), b[:50] / 2]).clip(
        0, 255
    )
    a = np.rint(a).astype(np.float32)
    found = matches._nearest(a, b).tolist()
    pairs = cv2.BFMatcher().knnMatch(a, b, k=2)
    assert found == [
        m.trainIdx if m.distance < matches.RATIO * second.distance else -1 for m, second in pairs
    ]
    assert 250 < sum(i >= 0 for i in found) < len(a)
