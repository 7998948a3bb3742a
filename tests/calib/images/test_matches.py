"""Matched points and quantities derived from them, against known rigs."""

import cv2
import numpy as np
import pytest
import torch

from arraygeom import apply_homography, epipolar_lines
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
from tests.calib.scenes import seen_points, texture, unlike_pair


def matched(rig, *, count=300, noise=0.0) -> PointMatches:
    (points,) = seen_points(rig, count=count, noise=noise).values()
    return points


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
    rig = unlike_pair()
    F, matches = rig.pair("first", "second").fundamental, matched(rig)
    assert line_distance(matches, F).max() < 1e-6
    wrong = PointMatches(matches.alpha, matches.beta.flip(0))
    both = PointMatches(torch.cat([matches.alpha, wrong.alpha]), torch.cat([matches.beta, wrong.beta]))
    assert 300 <= len(near_lines(both, F, within=1).alpha) < 330


def test_a_link_is_refined_and_its_map_reaches_the_points():
    rig = unlike_pair()
    F, matches = rig.pair("first", "second").fundamental, matched(rig, noise=0.2)
    shift = torch.tensor([[1.0, 0, 2.0], [0, 1, -2.0], [0, 0, 1]], dtype=torch.float64)
    off = torch.linalg.inv(shift).T @ F
    assert line_distance(matches, off).median() > 1
    fit = fit_link(matches, off)
    exact = matched(rig)
    assert line_distance(exact, fit.link.F).median() < 0.2
    away = exact.beta - apply_homography(fit.link.H, exact.alpha).x
    assert (away.norm(dim=-1) < fit.displacement + 3).double().mean() > 0.9
    line = epipolar_lines(fit.link.F, exact.alpha)
    along = (away * torch.stack([line[:, 1], -line[:, 0]], -1)).sum(-1)
    assert fit.displacement < 0.55 * (along.max() - along.min())


def test_a_link_needs_points_that_agree():
    rig = unlike_pair()
    matches = matched(rig)
    other = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, -500]], dtype=torch.float64)
    with pytest.raises(ValueError):
        fit_link(matches, other)


def test_depths_contain_the_matched_points():
    rig = unlike_pair()
    near, far = seen_depths(rig.pair("first", "second"), matched(rig, noise=0.1))
    assert 1.7 < near < 2.0
    assert 6.0 < far < 7.6


def test_depths_need_points_that_fit():
    rig = unlike_pair()
    few = matched(rig, count=ENOUGH - 1)
    with pytest.raises(ValueError, match=str(ENOUGH - 1)):
        seen_depths(rig.pair("first", "second"), few)


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
