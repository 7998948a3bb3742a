"""Nearest points, held against all distances."""

import numpy as np
import pytest

from pat.support.neighbours import nearest_points


@pytest.mark.parametrize("error", [0.0, 0.5])
def test_the_nearest_points_are_those_of_all_distances(error):
    rng = np.random.default_rng(0)
    points, queries = rng.random((3000, 7), np.float32), rng.random((200, 7), np.float32)
    index, distance = nearest_points(points, queries, 5, error)
    apart = np.linalg.norm(points[index] - queries[:, None], axis=-1)
    assert np.abs(apart - distance).max() < 1e-5
    assert (np.diff(distance, axis=1) >= 0).all()
    truth = np.sort(np.linalg.norm(points - queries[:, None], axis=-1), axis=1)[:, :5]
    assert (distance <= truth * (1 + error) + 1e-5).all()


@pytest.mark.parametrize(
    ("points", "queries", "count"),
    [
        (np.ones((9, 3)), np.ones((2, 3)), 0),
        (np.ones((9, 3)), np.ones((2, 3)), 10),
        (np.ones((0, 3)), np.ones((2, 3)), 1),
        (np.ones((9, 3)), np.full((2, 3), np.nan), 1),
        (np.full((9, 3), np.inf), np.ones((2, 3)), 1),
    ],
)
def test_what_has_no_nearest_points_is_refused(points, queries, count):
    """No neighbours wanted ended the process."""
    with pytest.raises(ValueError, match="points"):
        nearest_points(points, queries, count)


def test_without_queries_there_are_no_neighbours():
    index, distance = nearest_points(np.ones((9, 3)), np.ones((0, 3)), 2)
    assert index.shape == distance.shape == (0, 2)


def test_a_point_is_its_own_nearest_and_all_points_can_be_asked_for():
    points = np.random.default_rng(1).random((6, 3))
    index, distance = nearest_points(points, points, 6)
    assert index[:, 0].tolist() == list(range(6))
    assert np.array_equal(np.sort(index, axis=1), np.broadcast_to(np.arange(6), (6, 6)))
    assert distance[:, 0].max() == 0
