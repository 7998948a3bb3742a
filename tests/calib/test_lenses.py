"""F through lenses: fits where lines bend, adds nothing where they do not."""

import torch

from arraygeom import Camera, Distortion, Pose, Rig, intrinsics, rotation_from_vector
from calib.lenses import fit_bent
from calib.matches import Matches, fit_fundamental, line_distance
from calib.refine import split
from tests.calib.scenes import vector

HW = (480, 640)


def pair(k1: float) -> Rig:
    turn = rotation_from_vector(torch.deg2rad(vector(1, -6, 2)))
    poses = Pose.identity(), Pose.from_centre(turn, vector(0.5, 0.05, 0.0))
    lens = Distortion("brown-conrady", vector(k1, 0.2 * k1**2, 0, 0))
    cameras = [Camera(K=intrinsics(f, HW), cam_from_world=p, hw=HW, distortion=lens) for f, p in zip((700, 650), poses)]
    return Rig(dict(zip("ab", cameras)))


def matches(rig, *, count=600, noise=0.05) -> Matches:
    """Points at 2 to 7 m, one in twenty wrong."""
    g = torch.Generator().manual_seed(0)
    a, b = rig.pair("a", "b").cameras
    x = torch.rand(count, 2, generator=g, dtype=torch.float64) * vector(639, 479)
    y, _, valid = b.project(a.unproject(x, 2 + 5 * torch.rand(count, generator=g, dtype=torch.float64)))
    seen = valid & b.contains(y)
    y = y + noise * torch.randn(count, 2, generator=g, dtype=torch.float64)
    y[::20] += 4 * torch.randn(count, 2, generator=g, dtype=torch.float64)[::20]
    return Matches(x[seen], y[seen])


def medians(k1: float) -> tuple[float, float]:
    """Of held-out points' distances from their lines: by F alone, and through lenses."""
    (used,), (held_out,) = (list(part.values()) for part in split([{("a", "b"): matches(pair(k1))}]))
    straight, bent = line_distance(held_out, fit_fundamental(used)), fit_bent(used, HW, HW).line_distance(held_out)
    return float(straight.median()), float(bent.median())


def test_lines_that_bend_are_followed():
    straight, bent = medians(-0.25)
    assert bent < 0.06 < 0.15 < straight


def test_lenses_that_do_not_bend_change_nothing():
    straight, bent = medians(0.0)
    assert bent < 0.06
    assert bent < 1.2 * straight


def test_straightened_pixels_fit_the_f_that_comes_with_them():
    points = matches(pair(-0.25), noise=0.0)
    found = fit_bent(points, HW, HW)
    off = line_distance(found.straight(points), found.F)
    assert torch.allclose(off, found.line_distance(points))
    assert abs(float(torch.linalg.det(found.F / found.F.norm()))) < 1e-12
    middle = Matches(vector(319.5, 239.5)[None], vector(319.5, 239.5)[None])
    assert torch.equal(found.straight(middle).alpha, middle.alpha)
