"""Fields around known depth or matches: where the segments are, also as views change before fusion."""

import math

import pytest
import torch

from arraygeom import (
    Distortion,
    Link,
    Pair,
    Rectified,
    Rig,
    View,
    pinhole_view,
    pixel_grid,
    stack,
)
from arraygeom.fields import AroundDepth, AroundMatches, Epipolar
from tests.arraygeom.rigs import parallel_rig

HW = (60, 90)
LENS = Distortion("brown-conrady", torch.tensor([-0.15, 0.02, 1e-3, 0.0], dtype=torch.float64))


def rig_of(lens: Distortion | None = None) -> Rig:
    return parallel_rig(80.0, HW, {"a": (), "b": (0.2, -0.01)}, (1.0, 50.0), distortion=lens)


def straightened(rig: Rig, turns: int = 0) -> Rig:
    """Pinhole views in place of lenses, and the second one rotated, as before a fusion."""
    for name in rig.names:
        view = pinhole_view(rig[name])
        rig = rig.with_camera(name, view)
    return rig.rot90("b", turns)


def sloping(hw=HW) -> torch.Tensor:
    return 2 + 0.05 * pixel_grid(hw)[..., 0] + 0.02 * pixel_grid(hw)[..., 1]


def test_no_depth_range_is_needed_where_every_depth_is_known():
    rig, depth, x = rig_of(), sloping(), pixel_grid(HW, dtype=torch.float64)
    bare = Rig(rig.cameras).pair("a", "b")
    found, bounded = (AroundDepth(depth)(pair, x) for pair in (bare, rig.pair("a", "b")))
    assert torch.equal(found.start, bounded.start)
    assert torch.equal(found.valid, bounded.valid)
    depth[3, 5] = math.nan
    with pytest.raises(ValueError, match="depth"):
        AroundDepth(depth)(bare, x)


def test_segments_are_between_the_bounds_of_each_pixels_depth():
    pair, depth = rig_of().pair("a", "b"), sloping()
    x = pixel_grid(HW, dtype=torch.float64)[5:50, 40:80]
    found = AroundDepth(depth, 0.1)(pair, x)
    z = depth[5:50, 40:80].double()
    alpha, beta = pair.cameras
    for end, bound in ((found.start, z / 1.1), (found.end, z * 1.1)):
        expected = beta.project(alpha.unproject(x, bound)).x
        assert found.valid.all()
        assert torch.allclose(end, expected, atol=1e-6)
    point = AroundDepth(depth, 0.0)(pair, x)
    assert float(point.length.max()) < 1e-6


def test_where_depth_is_not_known_the_whole_range_is_searched():
    pair, depth = rig_of().pair("a", "b"), sloping()
    depth[10, 60], depth[11, 60], depth[12, 60] = math.nan, 0.0, math.inf
    x = torch.tensor([[60.0, 10.0], [60.0, 11.0], [60.0, 12.0]], dtype=torch.float64)
    found, whole = AroundDepth(depth)(pair, x), Epipolar()(pair, x)
    assert torch.allclose(found.start, whole.start)
    assert torch.allclose(found.end, whole.end)


def test_depth_is_of_the_pixels_as_recorded():
    """A map of the image with its lens serves the pinhole view that fusion makes of it."""
    rig, depth = rig_of(LENS), sloping()
    now = straightened(rig)
    lens, pinhole = rig["a"], now["a"]
    recorded = torch.tensor([[30.0, 12.0], [70.0, 50.0]], dtype=torch.float64)
    x = pinhole.project(lens.unproject(recorded, torch.ones(2).double())).x
    found = AroundDepth(depth, 0.0, lens)(now.pair("a", "b"), x)
    z = torch.stack([depth[12, 30], depth[50, 70]]).double()
    expected = now["b"].project(lens.unproject(recorded, z)).x
    assert torch.allclose(found.start, expected, atol=1e-4)


@pytest.mark.parametrize("turns", [0, 1])
def test_matches_are_of_the_pixels_as_recorded(turns):
    rig = rig_of(LENS)
    now = straightened(rig, turns)
    recorded = torch.tensor([[30.0, 12.0], [70.0, 50.0]], dtype=torch.float64)
    X = rig["a"].unproject(recorded, torch.tensor([2.5, 4.0]).double())
    field = AroundMatches.from_points(recorded, rig["b"].project(X).x, HW, 0.5, (rig["a"], rig["b"]))
    found = field(now.pair("a", "b"), now["a"].project(X).x)
    expected = now["b"].project(X).x
    assert found.valid.all()
    assert float((found.at(torch.full((2,), 0.5)) - expected).norm(dim=-1).max()) < 0.02
    assert torch.allclose(found.length, torch.ones(2).double(), atol=1e-3)


def test_matches_off_their_lines_do_not_count():
    pair = rig_of().pair("a", "b")
    x = torch.tensor([[30.0, 12.0], [70.0, 50.0]], dtype=torch.float64)
    whole = Epipolar()(pair, x)
    there = whole.at(torch.full((2,), 0.4)) + torch.tensor([[0.0, 1.5], [0.0, 4.0]])
    found = AroundMatches.from_points(x, there, HW, 1.0)(pair, x)
    assert found.length[0] < 2.1
    assert torch.equal(found.start[1], whole.start[1])


def test_points_beside_each_other_keep_their_own_matches():
    """A point is known in 3 x 3 pixels, but for those of other points."""
    alpha = pixel_grid(HW)[10:13, 20:30].reshape(-1, 2)
    beta = alpha - torch.rand(len(alpha), 2, generator=torch.Generator().manual_seed(0))
    positions = AroundMatches.from_points(alpha, beta, HW).positions
    assert torch.allclose(positions[10:13, 20:30].reshape(-1, 2), beta, atol=1e-5)
    assert positions[9:14, 19:31].isfinite().all()
    assert positions.isfinite().all(-1).sum() == 5 * 12


def test_disparities_of_a_rectified_pair_without_calibration():
    pair = Pair(View(hw=HW), View(hw=HW))
    there = pixel_grid(HW) - torch.tensor([6.0, 0.0])
    there[20, 50] = math.nan
    x = torch.tensor([[40.0, 20.0], [50.0, 20.0]], dtype=torch.float64)
    found = AroundMatches(there, 2.0, field=Rectified(20.0))(pair, x)
    assert found.start[0].tolist() == pytest.approx([32.0, 20.0])
    assert found.end[0].tolist() == pytest.approx([36.0, 20.0])
    assert found.length[1] == 20


def test_wrong_uses_are_refused():
    rig = rig_of()
    with pytest.raises(ValueError, match=r"90x59.*90x60"):
        AroundDepth(torch.ones(59, 90), 0.1, rig["a"])
    with pytest.raises(ValueError, match="tolerance"):
        AroundDepth(torch.ones(HW), -1.0)
    F = rig.pair("a", "b").fundamental
    linked = Pair(View(hw=HW), View(hw=HW), link=Link(F, torch.eye(3, dtype=torch.float64)))
    field = AroundMatches(torch.zeros(*HW, 2), 1.0, (rig["a"], rig["b"]))
    with pytest.raises(ValueError, match="without K"):
        field(linked, torch.zeros(1, 2))


def test_a_batch_of_rigs_is_a_loop():
    rigs = [rig_of(), rig_of().replace(depth=(2.0, 9.0))]
    x = torch.tensor([[10.0, 20.0], [30.0, 40.0]], dtype=torch.float64)
    plane = torch.full(HW, math.nan)
    plane[20, 10] = 4.0
    field = AroundDepth(plane, 0.1)
    found = field(stack(rigs).pair("a", "b"), x.expand(2, -1, -1))
    for i, rig in enumerate(rigs):
        torch.testing.assert_close(found.end[i], field(rig.pair("a", "b"), x).end)


def test_planes_of_another_size_are_refused_without_a_view_too():
    pair, x = rig_of().pair("a", "b"), torch.zeros(1, 2)
    for field in (AroundDepth(torch.ones(45, 45)), AroundMatches(torch.ones(45, 45, 2))):
        with pytest.raises(ValueError, match=r"45x45.*90x60"):
            field(pair, x)
