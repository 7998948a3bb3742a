"""The kernels of semi-global matching against slow twins, equal to the bit; what two pixels cost."""

import numpy as np
import pytest

from pat.matching import cost
from pat.matching import kernels as kernels

SMALL, LARGE = np.float32(20), np.float32(100)
HW, BETA = (5, 7), (6, 9)


def windows(rng, runs, count, spread):
    """First labels of each pixel, which begin up to `spread` labels apart; two runs do not overlap."""
    first = np.sort(rng.integers(0, spread + 1, (*HW, runs)), -1).astype(np.int32)
    if runs == 2:
        first[..., 1] = np.maximum(first[..., 1], first[..., 0] + count)
    return first


def lanes_of(runs, count):
    return kernels.NARROW if runs == 2 else -(-count // kernels.LANES) * kernels.LANES


def labels_of(first, count):
    """All labels of each pixel, one run after the other."""
    return (first[..., None] + np.arange(count)).reshape(*first.shape[:2], -1)


def slow_costs(own, other, labels, end, along, length, cut):
    """The cost of each label, as it is written down."""
    found = np.empty(labels.shape, np.uint8)
    for (y, x, k), label in np.ndenumerate(labels):
        column, row = np.floor(end[y, x] + np.float32(label) * along[y, x] + np.float32(0.5)).astype(int)
        if label > length[y, x] + np.float32(0.5):
            found[y, x, k] = cost.UNSEEN if cut[y, x] else cost.NOWHERE
        elif 0 <= row < BETA[0] and 0 <= column < BETA[1]:
            ones = bin(int(own[1][y, x] ^ other[1][row, column])).count("1")
            found[y, x, k] = ones + int(
                min(abs(own[0][y, x] - other[0][row, column]) * cost.BRIGHTNESS, cost.TRUNCATED)
            )
        else:
            found[y, x, k] = cost.NOWHERE
    return found


def slow_aggregate(costs, guide, labels):
    """Semi-global matching as it is written down, in parts: one path at a time, from each pixel's
    predecessor, whose labels may be others."""
    height, width, _ = costs.shape
    costs, total = kernels.PARTS * costs.astype(int), np.zeros(costs.shape, int)
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        path = costs.copy()
        for y in range(height)[:: 1 if dy >= 0 else -1]:
            for x in range(width)[:: 1 if dx >= 0 else -1]:
                y0, x0 = y - dy, x - dx
                if 0 <= y0 < height and 0 <= x0 < width:
                    before, edge = path[y0, x0], abs(guide[y, x] - guide[y0, x0]) / kernels.EDGE
                    jump = int(float(max(SMALL + np.float32(1), LARGE / (1 + edge))) * kernels.PARTS + 0.5)
                    apart = np.abs(labels[y, x][:, None] - labels[y0, x0])
                    step = np.where(apart == 0, 0, np.where(apart == 1, int(SMALL) * kernels.PARTS, jump))
                    path[y, x] += (before + step).min(1) - before.min()
                    path[y, x] = np.minimum(path[y, x], costs[y, x] + jump)
        total += path
    return total


@pytest.fixture
def views():
    """Planes of alpha, those of beta, and segments that leave beta, or end, or are none."""
    rng = np.random.default_rng(0)
    own, other = (
        (rng.random(hw, np.float32), rng.integers(0, 2**48, hw).astype(np.uint64)) for hw in (HW, BETA)
    )
    end = rng.uniform(0, 8, (*HW, 2)).astype(np.float32)
    angle = rng.uniform(0, 2 * np.pi, HW)
    along = np.stack([np.cos(angle), np.sin(angle)], -1).astype(np.float32)
    length = rng.uniform(2, 12, HW).astype(np.float32)
    length[0, :3] = -1
    return own, other, (end, along, length, rng.integers(0, 2, HW).astype(np.float32))


def flat(planes):
    return tuple(plane.ravel() for plane in planes)


@pytest.mark.parametrize(
    ("runs", "count", "spread"), [(1, 6, 0), (1, 19, 0), (1, 16, 3), (2, 5, 4), (2, 4, 9)]
)
def test_costs_are_those_of_their_slow_twin(views, runs, count, spread):
    own, other, segments = views
    first = windows(np.random.default_rng(1), runs, count, spread)
    out = np.empty((*HW, runs, lanes_of(runs, count)), np.uint8)
    kernels.costs(flat(own), flat(other), first, count, *segments, *BETA, out)
    found = out[..., :count].reshape(*HW, -1)
    np.testing.assert_array_equal(found, slow_costs(own, other, labels_of(first, count), *segments))
    assert (out[..., count:] == kernels.NO_LABEL).all()


@pytest.mark.parametrize("spread", [0, 1, 3, 9, 40])
@pytest.mark.parametrize(("runs", "count"), [(1, 6), (1, 16), (1, 21), (2, 5), (2, 3)])
def test_aggregation_is_that_of_its_slow_twin(runs, count, spread):
    """For equal, overlapping and disjoint labels of neighbours."""
    rng = np.random.default_rng(spread)
    first = windows(rng, runs, count, spread)
    costs = np.full((*HW, runs, lanes_of(runs, count)), kernels.NO_LABEL)
    costs[..., :count] = rng.integers(0, cost.NOWHERE + 1, (*HW, runs, count))
    guide, total = 0.1 * rng.random(HW, np.float32), np.empty(costs.shape, np.int16)
    kernels.aggregate(costs, guide, first, count, SMALL, LARGE, total)
    wanted = slow_aggregate(costs[..., :count].reshape(*HW, -1), guide, labels_of(first, count))
    np.testing.assert_array_equal(total[..., :count].reshape(*HW, -1), wanted)


@pytest.mark.parametrize(("runs", "count", "spread"), [(1, 12, 0), (1, 9, 3), (2, 5, 4)])
def test_winners_are_those_of_their_slow_twin(views, runs, count, spread):
    rng, (end, along, length, cut) = np.random.default_rng(2), views[2]
    first = windows(rng, runs, count, spread)
    total = rng.integers(0, 20000, (*HW, runs, lanes_of(runs, count))).astype(np.int16)
    claims, off = np.full(BETA[0] * BETA[1] + 1, 2**31 - 1, np.int32), BETA[0] * BETA[1]
    disparity, positions, facts = (
        np.empty(HW, np.float32),
        np.empty(HW, np.int32),
        np.empty((*HW, 3), np.float32),
    )
    segments, results = (end, along, length, cut), (disparity, facts, positions)
    kernels.winners(total, first, count, segments, BETA, (0, 0), LARGE, claims, results)
    labels, sums = labels_of(first, count), total[..., :count].reshape(*HW, -1)
    wanted = np.full(off + 1, 2**31 - 1)
    for y, x in np.ndindex(HW):
        place = np.floor(end[y, x] + labels[y, x][:, None].astype(np.float32) * along[y, x] + 0.5).astype(int)
        on = labels[y, x] <= length[y, x] + 0.5
        inside = on & (place >= 0).all(1) & (place < BETA[::-1]).all(1)
        at = np.where(inside, place[:, 1] * BETA[1] + place[:, 0], off)
        for label, claimed, its in zip(labels[y, x][on], at[on], sums[y, x][on]):
            wanted[claimed] = min(wanted[claimed], int(its) << 16 | int(label))
        allowed = on if on.any() else np.arange(len(on)) == 0
        allowed = allowed | bool(cut[y, x])
        best = int(np.where(allowed, sums[y, x].astype(int), 2**15).argmin())
        rest = sums[y, x][allowed & (np.abs(labels[y, x] - labels[y, x, best]) > 1)]
        assert positions[y, x] == at[best]
        assert facts[y, x, 0] == labels[y, x, best]
        there = end[y, x] + labels[y, x, best] * along[y, x]
        shift = (np.floor(there + 0.5) - there) @ along[y, x]
        assert abs(disparity[y, x] - shift - labels[y, x, best]) <= 0.5 + 1e-5
        unit = 8 * kernels.PARTS * LARGE
        second = min(rest, default=max(int(kernels.UNRELATED * unit), sums[y, x, best]))
        margin = min((second - sums[y, x, best]) / unit, 1)
        np.testing.assert_allclose(facts[y, x, 1:], [margin, sums[y, x, best] / unit], rtol=1e-6)
    np.testing.assert_array_equal(claims, wanted)


def test_census_is_which_of_48_neighbours_are_darker():
    image = np.random.default_rng(1).random((9, 11)).astype(np.float32)
    bits = cost.planes_of(image)[1]
    y, x = 4, 5
    window = image[y - 3 : y + 4, x - 3 : x + 4].ravel()
    darker = np.delete(window, 24) < image[y, x]
    assert f"{int(bits[y, x]):048b}" == "".join(str(int(d)) for d in darker)


@pytest.mark.parametrize(("cut", "beyond"), [(1.0, cost.UNSEEN), (0.0, cost.NOWHERE)])
def test_labels_beyond_a_segment_are_unseen_where_beta_ends_and_nowhere_else(cut, beyond):
    own = np.zeros(1, np.float32), np.zeros(1, np.uint64)
    other = np.ones(9, np.float32), np.full(9, 2**48 - 1, np.uint64)
    ends, along = np.array([[[2.0, 0.0]]], np.float32), np.array([[[-1.0, 0.0]]], np.float32)
    length, edge = np.full((1, 1), 2, np.float32), np.full((1, 1), cut, np.float32)
    costs, labels = np.empty((1, 1, 1, kernels.LANES), np.uint8), (np.zeros((1, 1, 1), np.int32), 5)
    segments = ends, along, length, edge
    kernels.costs(own, other, *labels, *segments, 1, 9, costs)
    unlike = 48 + int(cost.TRUNCATED)
    assert costs.ravel()[:5].tolist() == [unlike] * 3 + [beyond] * 2
    disparity, facts = np.empty((1, 1), np.float32), np.empty((1, 1, 1), np.float32)
    claims, place = np.full(10, 2**31 - 1, np.int32), np.empty((1, 1), np.int32)
    total = (kernels.PARTS * costs.astype(int)).astype(np.int16)
    kernels.winners(total, *labels, segments, (1, 9), (0, 0), LARGE, claims, (disparity, facts, place))
    assert (disparity[0, 0] > 2) == (cut == 1)
    assert (place[0, 0] == 9) == (cut == 1)
    assert claims[[0, 1, 2]].tolist() == [(unlike * kernels.PARTS << 16) + label for label in (2, 1, 0)]
    assert (claims[3:] == 2**31 - 1).all()
