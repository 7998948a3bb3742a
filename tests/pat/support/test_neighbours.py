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


def test_a_point_is_its_own_nearest_and_all_points_can_be_asked_for():
    points = np.random.default_rng(1).random((6, 3))
    index, distance = nearest_points(points, points, 6)
    assert index[:, 0].tolist() == list(range(6))
    assert np.array_equal(np.sort(index, axis=1), np.broadcast_to(np.arange(6), (6, 6)))
    assert distance[:, 0].max() == 0
