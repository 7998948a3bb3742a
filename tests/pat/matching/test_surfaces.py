"""Planes through what is known around each pixel."""

import cv2
import numpy as np
import pytest

from pat.matching.subpixel import SETTINGS, Planes

H, W = 120, 160


def whole_and_every_second(right: float, down: float) -> tuple[np.ndarray, np.ndarray]:
    """A plane at all pixels, and what of it is known."""
    y, x = np.mgrid[:H, :W].astype(np.float32)
    whole = 30 + right * x + down * y
    return whole, whole[::2, ::2]


def test_planes_are_the_weighted_least_squares_around_each_pixel():
    """Solved again at some pixels, from means by the same filter; in a diagonal band, where positions across
    and down go together. A slope counts as the variance of positions and `level` say."""
    rng, reach = np.random.default_rng(0), 24.0
    _, values = whole_and_every_second(1 / 20, -1 / 30)
    y, x = np.mgrid[: H // 2, : W // 2].astype(np.float32)
    weight = (rng.random(values.shape) * (np.abs(x * 0.75 - y) < 12)).astype(np.float32)
    values = values + rng.normal(0, 0.3, values.shape).astype(np.float32)
    guide = (values[..., None] / 8).astype(np.float32)
    planes = Planes.through(values, weight, guide, reach)
    over = cv2.ximgproc.createDTFilter(guide, reach / 2, 1.0, cv2.ximgproc.DTF_RF)
    total = over.filter(weight)

    def mean(part):
        return over.filter((part * weight).astype(np.float32)) / total

    position, z = np.stack([x, y], -1) / (reach / 2), values - values.mean()
    middle = np.stack([mean(position[..., i]) for i in range(2)], -1)
    assert planes.around == pytest.approx(mean(weight), rel=1e-3)
    for r, c in [(10, 14), (30, 40), (45, 60), (28, 44)]:
        away = position - middle[r, c]
        spread = [[mean(away[..., i] * away[..., j])[r, c] for i in range(2)] for j in range(2)]
        common = [mean(away[..., i] * z)[r, c] for i in range(2)]
        slope = np.linalg.solve(np.array(spread) + SETTINGS.level * np.eye(2), common)
        value = mean(z)[r, c] + slope @ (position - middle)[r, c] + values.mean()
        found = planes.value[r, c], planes.right[r, c] * reach, planes.down[r, c] * reach
        assert found == pytest.approx((value, *slope), abs=5e-3)


def test_all_pixels_of_odd_sides_lie_on_the_plane():
    """To the accuracy of the next pixel's step, which is a fifth."""
    whole, _ = whole_and_every_second(0.2, -0.2)
    whole = whole[:119, :159]
    values = whole[::2, ::2]
    planes = Planes.through(values, np.ones_like(values), np.zeros((*values.shape, 1), np.float32), 24.0)
    error = np.abs(planes.at_pixels((119, 159)) - whole)
    assert error[30:-30, 30:-30].max() < 0.02


def test_an_edge_of_the_guide_parts_planes():
    _, values = whole_and_every_second(0.05, 0.0)
    step = np.where(np.arange(W // 2) < 40, 0, 7).astype(np.float32)
    guide = np.broadcast_to(step / 7 * 50, values.shape)[..., None].astype(np.float32)
    planes = Planes.through(values + step, np.ones_like(values), guide, 24.0)
    assert np.abs(planes.value - values - step).max() < 0.2
