"""Planes through what is known around each pixel."""

import numpy as np
import pytest

from pat.matching.surfaces import Planes

H, W = 120, 160


def whole_and_every_second(right: float, down: float) -> tuple[np.ndarray, np.ndarray]:
    """A plane at all pixels, and what of it is known."""
    y, x = np.mgrid[:H, :W].astype(np.float32)
    whole = 30 + right * x + down * y
    return whole, whole[::2, ::2]


def test_a_plane_is_found_from_a_part_of_its_pixels():
    """A diagonal band, in which positions across and down go together."""
    whole, values = whole_and_every_second(1 / 20, -1 / 30)
    y, x = np.mgrid[: H // 2, : W // 2]
    weight = (np.abs(x * 0.75 - y) < 12).astype(np.float32) * np.float32(0.5)
    guide = np.zeros((*values.shape, 1), np.float32)
    planes = Planes.through(np.where(weight > 0, values, 1000), weight, guide, 60.0)
    inside = weight > 0
    # A little flatter: planes are level where positions hardly differ.
    assert planes.right[inside] == pytest.approx(1 / 20, rel=0.2)
    assert planes.down[inside] == pytest.approx(-1 / 30, rel=0.2)
    assert planes.around[inside] == pytest.approx(0.5, abs=1e-4)
    found = planes.at_pixels((H, W))
    assert np.abs(found - whole)[inside.repeat(2, 0).repeat(2, 1)].max() < 0.1


def test_all_pixels_of_odd_sides_lie_on_the_plane():
    """As exact as to the next pixel's step, which is a fifth."""
    whole, _ = whole_and_every_second(0.2, -0.2)
    whole = whole[:119, :159]
    values = whole[::2, ::2]
    planes = Planes.through(values, np.ones_like(values), np.zeros((*values.shape, 1), np.float32), 24.0)
    error = np.abs(planes.at_pixels((119, 159)) - whole)
    assert error[30:-30, 30:-30].max() < 0.02


def test_an_edge_of_the_guide_parts_planes():
    whole, values = whole_and_every_second(0.05, 0.0)
    step = np.where(np.arange(W // 2) < 40, 0, 7).astype(np.float32)
    guide = np.broadcast_to(step / 7 * 50, values.shape)[..., None].astype(np.float32)
    planes = Planes.through(values + step, np.ones_like(values), guide, 24.0)
    assert np.abs(planes.value - values - step).max() < 0.2
