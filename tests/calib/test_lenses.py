"""Cameras with lenses in place of F: lines that bend are found, where straight ones cannot fit."""

import pytest
import torch

from arraygeom import Camera, Distortion, Link, Pose, Rig, View, intrinsics, rotation_from_vector
from calib.lenses import FREE, SIGMA, with_cameras
from calib.matches import Matches, fit_fundamental
from calib.refine import refine_matches
from tests.calib.scenes import vector

HW = (480, 640)


def camera(focal, centre, turn, k1):
    pose = Pose.from_centre(rotation_from_vector(torch.deg2rad(vector(*turn))), vector(*centre))
    lens = Distortion("brown-conrady", vector(k1, 0.05, 0, 0))
    return Camera(K=intrinsics(focal, HW), cam_from_world=pose, hw=HW, distortion=lens)


def three() -> Rig:
    return Rig(
        {
            "a": camera(700.0, (0, 0, 0), (0, 0, 0), -0.22),
            "b": camera(650.0, (0.5, 0.05, 0.0), (1, -6, 2), -0.18),
            "c": camera(800.0, (-0.1, 0.35, 0.05), (-5, 1, -1), -0.25),
        }
    )


def matches(rig, names, *, count=500, noise=0.05) -> Matches:
    """Points of the first at 2 to 7 m, as both see them; the same points of it for every other."""
    g = torch.Generator().manual_seed(0)
    a, b = rig.pair(*names).cameras
    x = torch.rand(count, 2, generator=g, dtype=torch.float64) * vector(639, 479)
    X = a.unproject(x, 2 + 5 * torch.rand(count, generator=g, dtype=torch.float64))
    y, _, valid = b.project(X)
    seen = valid & b.contains(y)
    y = y + noise * torch.randn(count, 2, generator=torch.Generator().manual_seed(len(names[1])), dtype=torch.float64)
    return Matches(x[seen], y[seen])


def known_by_f(rig, pairs) -> Rig:
    links = {names: Link(fit_fundamental(found)) for names, found in pairs.items()}
    return Rig({name: View(hw=HW) for name in rig.names}, links=links)


def test_lenses_are_found_where_f_cannot_fit():
    pairs = {("a", "b"): matches(three(), ("a", "b"))}
    rig = Rig({n: View(hw=HW) for n in "ab"}, links=known_by_f(three(), pairs | {}).links)
    straight = refine_matches(rig, [pairs])
    bent = refine_matches(with_cameras(rig, pairs), [pairs], free=FREE, sigma=SIGMA)
    assert bent.accepted
    assert bent.held_out[1].median < 0.1 < 0.3 < straight.held_out[1].median
    assert all(float(c.distortion.coefficients[0]) < -0.05 for c in bent.rig.cameras.values())


def test_pairs_share_one_unit_of_length():
    true = three()
    pairs = {names: matches(true, names, noise=0.0) for names in (("a", "b"), ("a", "c"))}
    found = with_cameras(known_by_f(true, pairs), pairs)
    assert not found.links
    lengths = [float(found[n].centre.norm() / true[n].centre.norm()) for n in "bc"]
    assert lengths[1] == pytest.approx(lengths[0], rel=0.25)


def test_a_camera_that_nothing_joins_is_named():
    true = three()
    found = {("a", "b"): matches(true, ("a", "b")), ("c", "d"): matches(true, ("a", "c"))}
    rig = Rig({n: View(hw=HW) for n in "abcd"}, links={n: Link(fit_fundamental(m)) for n, m in found.items()})
    with pytest.raises(ValueError, match="no pictures join 'c', 'd' to the others"):
        with_cameras(rig, found)
