"""Calibrated pairs from matched points alone."""

import dataclasses
import math

import pytest
import torch

from arraygeom import Distortion, LensView, Link, Pose, Rig, intrinsics
from arraygeom.pixels import coarse_grid
from calib.images import self_calibration
from calib.images.matches import PointMatches, with_map
from calib.images.residuals import line_distances
from calib.images.self_calibration import (
    RefinedPair,
    dense_matches,
    joined,
    refined_by_depth,
    self_calibrated,
)
from tests.calib.scenes import HW, rectified_images, rectified_pair, seen_points, unlike_pair


def calibrated_from(rig: Rig, matches: PointMatches, **focal: float) -> RefinedPair | None:
    names = rig.names
    link = with_map(rig.pair(*names), matches).link
    return self_calibrated(rig.cameras, link, matches, focal=focal)


@pytest.mark.parametrize(
    ("make", "focal"), [(rectified_pair, {}), (unlike_pair, {"first": 305.0, "second": 332.0})]
)
def test_lines_are_as_good_as_with_the_calibration(make, focal):
    rig = make()
    names = rig.names
    (matches,) = seen_points(rig, noise=0.1, near=1.6, far=7.0).values()
    found = calibrated_from(rig, matches, **focal)
    exact = seen_points(rig, noise=0.0, near=1.6, far=7.0, seed=1)
    assert float(line_distances(found.rig, exact).abs().median()) < 0.15
    assert found.rig.names == names
    assert float(found.rig.pair(*names).beta_from_alpha.t.norm()) == pytest.approx(1)


def test_pose_and_bounds_are_found_with_the_focal_lengths():
    rig = rectified_pair()
    (matches,) = seen_points(rig, noise=0.1, near=2.0, far=6.0).values()
    found = calibrated_from(rig, matches, left=300.0, right=300.0)
    pose = found.rig.pair(*rig.names).beta_from_alpha
    assert pose.t.tolist() == pytest.approx([-1, 0, 0], abs=0.1)
    assert math.degrees(float((pose.R - torch.eye(3)).norm())) < 1.5
    near, far = (float(bound) for bound in found.rig.depth)
    assert near < 2.0 / 0.2
    assert far > 6.0 / 0.2


@pytest.mark.parametrize("side", [1, -1], ids=["below", "above"])
def test_most_points_are_in_front_where_some_are_behind(side):
    """Views shifted towards each other, whose far points have negative disparities, have the same lines."""
    rig = rectified_pair()
    a, b = rig.names
    apart = Pose(torch.eye(3, dtype=torch.float64), torch.tensor([0, -0.2 * side, 0], dtype=torch.float64))
    rig = rig.with_camera(b, rig[b].replace(cam_from_world=apart))
    (matches,) = seen_points(rig, noise=0.1, near=2.0, far=6.0).values()
    matches.beta[::6] = matches.alpha[::6] + torch.tensor([0, 8.0 * side])
    found = calibrated_from(rig, matches, **dict.fromkeys(rig.names, 300.0))
    assert found.rig.pair(a, b).beta_from_alpha.t.tolist() == pytest.approx([0, -side, 0], abs=0.1)


def test_a_start_whose_baseline_vanishes_is_left_out(monkeypatch):
    """Matches do not determine the baseline's length: from a wrong start it shrank to 0 (Cloth3 of 2006)."""
    rig = rectified_pair()
    (matches,) = seen_points(rig, noise=0.1, near=2.0, far=6.0).values()
    refine, calls = self_calibration.refine_matches, []

    def vanishing(rig, *args, **kwargs):
        found = refine(rig, *args, **kwargs)
        calls.append(found)
        if len(calls) > 1:
            return found
        name = rig.names[1]
        short = found.rig[name].replace(cam_from_world=Pose(found.rig[name].R, 0 * found.rig[name].t))
        return dataclasses.replace(found, rig=found.rig.with_camera(name, short))

    monkeypatch.setattr(self_calibration, "refine_matches", vanishing)
    assert calibrated_from(rig, matches).rig.pair(*rig.names).beta_from_alpha.t.norm() == pytest.approx(1)
    assert len(calls) > 1


def test_focal_lengths_that_the_points_contradict_give_rough_depths_alone():
    rig = unlike_pair()
    (matches,) = seen_points(rig, noise=0.05, near=1.6, far=7.0).values()
    found = calibrated_from(rig, matches, first=3000.0, second=60.0)
    assert found is None or not found.exact


def test_cameras_have_the_lenses_of_their_views():
    """Views with lenses have depth: pinholes' lines would not fit."""
    rig = rectified_pair()
    (matches,) = seen_points(rig, noise=0.1, near=2.0, far=6.0).values()
    lens = Distortion("brown-conrady", torch.tensor([-0.08, 0.01, 0.002, -0.001], dtype=torch.float64))
    views = {n: LensView(hw=HW, K=intrinsics(max(HW) / 2, HW), distortion=lens) for n in rig.names}
    link = with_map(rig.pair(*rig.names), matches).link
    seen = PointMatches(*(view.distort(x)[0] for view, x in zip(views.values(), matches)))
    found = self_calibrated(views, link, seen, focal=dict.fromkeys(rig.names, 300.0))
    assert not found.exact
    x = coarse_grid(HW).reshape(-1, 2)
    for name, view in views.items():
        there, same = found.rig[name].distort(x)[0], view.distort(x)[0]
        assert float((there - same).abs().max()) < 1e-6
    pose = found.rig.pair(*rig.names).beta_from_alpha
    assert pose.t.tolist() == pytest.approx([-1, 0, 0], abs=0.1)


def test_dense_matches_follow_from_a_depth_map():
    rig, images = rectified_pair(), rectified_images()
    depth = torch.full(HW, 60 / 11)
    depth[HW[0] // 2 :] = 3.0
    matches = dense_matches(rig, images, depth, torch.ones(HW))
    disparity = matches.alpha[:, 0] - matches.beta[:, 0]
    wanted = torch.where(matches.alpha[:, 1] < HW[0] // 2, 11.0, 20.0).double()
    inner = (matches.alpha[:, 1] - HW[0] / 2).abs() > 12
    assert len(matches.alpha) > 500
    assert float((disparity - wanted)[inner].abs().median()) < 0.05
    assert not len(dense_matches(rig, images, depth, torch.zeros(HW)).alpha)
    pair = RefinedPair(rig, 30, 0.5)
    assert refined_by_depth(pair, images, depth, torch.zeros(HW)) is pair
    assert refined_by_depth(pair, images, depth, torch.ones(HW)).points > 500


def test_pairs_are_joined_at_their_scales():
    pair = rectified_pair()
    other = Rig({"left": pair["left"], "up": pair["right"]}, depth=(3.0, 9.0))
    rig = joined(
        {"right": RefinedPair(pair, 1, 0.0), "up": RefinedPair(other, 1, 0.0)}, {"right": 1.0, "up": 0.5}
    )
    assert rig.names == ("left", "right", "up")
    assert torch.allclose(rig["up"].t, 0.5 * rig["right"].t)
    assert [float(bound) for bound in rig.depth] == [1.5, 8.0]


def test_points_off_their_lines_calibrate_nothing():
    rig = rectified_pair()
    matches = PointMatches(torch.zeros(30, 2).double(), torch.tensor([0.0, 50.0]).double().expand(30, 2))
    link = Link(F=rig.pair(*rig.names).fundamental)
    assert self_calibrated(rig.cameras, link, matches, focal={}) is None
