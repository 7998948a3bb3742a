"""A common focal length from matched points: found where they determine it, and else left as assumed."""

import cv2
import numpy as np
import pytest
import torch

from arraygeom import Camera, Link, Pose, Rig, intrinsics, rotation_from_vector
from calib.images import focal_length
from calib.images.focal_length import common_focal_length, fit_focal_length
from calib.images.matches import PointMatches, fit_fundamental
from tests.calib.scenes import HW, rectified_pair, vector

ASSUMED = 1.2 * max(HW)


def views_and_points(rig: Rig, *, seed: int = 0, count: int = 500):
    """Return a rig's views, F of its points, and the points in front, good to 0.15 pixels, some of them
    wrong."""
    g = np.random.default_rng(seed)
    alpha, beta = rig.cameras.values()
    x = torch.from_numpy(g.uniform(0, 1, (8 * count, 2)) * np.array(HW[::-1]))
    y, _, valid = beta.project(alpha.unproject(x, torch.from_numpy(1 / g.uniform(0.2, 1, len(x)))))
    seen = valid & beta.contains(y)
    x, y = (part[seen][:count] for part in (x, y))
    wrong = torch.from_numpy(g.uniform(size=(len(x), 1)) < 0.05)
    x, y = (part + torch.from_numpy(g.normal(0, 0.15, part.shape)) for part in (x, y))
    y = torch.where(wrong, y + torch.from_numpy(g.uniform(-5, 5, y.shape)), y)
    cv2.setRNGSeed(0)
    matches = PointMatches(x, y)
    return rig.cameras, Link(fit_fundamental(matches)), matches


def hand_held(focal: float) -> Rig:
    """Two views of one camera whose axes do not meet: beta is right, nearer, and turned about all axes."""
    first = Camera(K=intrinsics(focal, HW, (162.0, 117.5)), cam_from_world=Pose.identity(), hw=HW)
    R = rotation_from_vector(vector(0.12, -0.22, 0.08))
    return Rig(
        {"left": first, "right": first.replace(cam_from_world=Pose.from_centre(R, vector(0.35, 0.1, 0.2)))}
    )


@pytest.mark.parametrize("focal", [160.0, 190.0])
def test_a_focal_length_is_found_where_points_determine_it(focal):
    found = common_focal_length(*views_and_points(hand_held(focal)))
    assert found is not None
    assert found.deviation < 0.25
    assert abs(found.length / focal - 1) < 2.5 * found.deviation
    assert abs(found.length / focal - 1) < 0.15


@pytest.mark.parametrize("focal", [190.0, 300.0, 800.0])
def test_parallel_cameras_leave_it_as_assumed(focal):
    alpha, beta = rectified_pair().cameras.values()
    K = intrinsics(focal, HW)
    rig = Rig({"left": alpha.replace(K=K), "right": beta.replace(K=K)})
    given = views_and_points(rig)
    assert common_focal_length(*given) is None
    fit = fit_focal_length(*given)
    assert fit is not None
    assert fit.deviation > 0.25


def test_one_that_is_as_assumed_is_not_said_to_be_found():
    given = views_and_points(hand_held(ASSUMED))
    fit = fit_focal_length(*given)
    assert fit is not None
    assert abs(fit.length / ASSUMED - 1) < 0.15
    assert common_focal_length(*given) is None


def test_stated_deviations_are_those_of_repeated_draws():
    errors = []
    for seed in range(6):
        fit = fit_focal_length(*views_and_points(hand_held(420.0), seed=seed, count=250))
        errors.append(np.log(fit.length / 420) / fit.deviation)
    assert np.sqrt(np.mean(np.square(errors))) < 1.5


def test_held_out_points_decide(monkeypatch):
    given = views_and_points(hand_held(190.0))
    monkeypatch.setattr(focal_length, "nearer", lambda *distances: False)
    assert common_focal_length(*given) is None


def test_mirrored_points_and_unlike_sizes_have_none():
    """A mirrored image's points would give half the true focal length, to 8 %."""
    views, link, matches = views_and_points(hand_held(190.0))
    mirrored = PointMatches(matches.alpha, matches.beta * vector(-1, 1) + vector(HW[1] - 1, 0))
    assert fit_focal_length(views, Link(fit_fundamental(mirrored)), mirrored) is None
    other = {"left": views["left"], "right": views["right"].replace(hw=(HW[0], HW[1] + 1))}
    assert fit_focal_length(other, link, matches) is None
