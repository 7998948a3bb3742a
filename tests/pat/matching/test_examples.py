"""Unseen pixels by example: they take the colour of the seen pixels most alike."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from arraygeom import Segments
from pat.matching import examples
from pat.matching.colour_transfer import SETTINGS, by_examples, directions_of, filled_from

H, W = 64, 96
RED, BLUE = np.float32([0.3, -0.1, -0.1]), np.float32([-0.1, -0.1, 0.3])
ROWS = np.float64([[1, 0], [0, 0]])
"""All segments run along rows."""
UNSEEN = 40
"""Columns from the left that no beta sees."""


def coloured(first: np.ndarray) -> np.ndarray:
    """Red where it holds, else blue."""
    return np.where(first, RED[:, None, None], BLUE[:, None, None])


def hidden(colour: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """The colour with noise in place of the columns that are not seen, and the weight of each pixel."""
    weight = np.ones((H, W), np.float32)
    weight[:, :UNSEEN] = 0.0
    noise = np.random.default_rng(seed).random(colour.shape, np.float32)
    return np.where(weight > 0, colour, noise), weight


def bands_of_brightness() -> tuple[np.ndarray, np.ndarray]:
    """Alpha bright and dark in turn, in bands across, and its colours."""
    bright = np.broadcast_to((np.arange(H) // 16 % 2 == 0)[:, None], (H, W))
    return np.where(bright, np.float32(0.7), np.float32(0.3)), coloured(bright)


def bands_of_texture() -> tuple[np.ndarray, np.ndarray]:
    """Alpha of one mean brightness, rough and smooth in turn, and its colours."""
    rough = np.broadcast_to((np.arange(H) // 16 % 2 == 0)[:, None], (H, W))
    noise = np.random.default_rng(3).standard_normal((H, W)).astype(np.float32)
    return np.where(rough, np.float32(0.5) + np.float32(0.1) * noise, np.float32(0.5)), coloured(rough)


@pytest.mark.parametrize("scene", [bands_of_brightness, bands_of_texture])
def test_an_unseen_pixel_has_the_colour_of_the_seen_ones_most_alike(scene):
    alpha, colour = scene()
    found = by_examples(*hidden(colour)[:1], alpha, hidden(colour)[1], ROWS)
    inside = np.arange(H) % 16
    rows = (inside > 2) & (inside < 13)
    off = np.abs(found - colour)[:, rows, :UNSEEN]
    assert off.mean() < 0.02
    assert off.mean() < 0.1 * np.abs(colour - colour.mean((1, 2), keepdims=True)).mean()


def test_of_what_looks_alike_the_nearest_counts():
    alpha = np.full((H, 400), 0.5, np.float32)
    left = np.broadcast_to(np.arange(400) < 200, alpha.shape)
    colour, weight = coloured(left), np.ones_like(alpha)
    weight[:, 40:60] = weight[:, 340:360] = 0.0
    found = by_examples(np.where(weight > 0, colour, 0), alpha, weight, ROWS)
    assert np.abs(found - colour)[:, weight == 0].max() < 1e-3


def test_what_is_seen_stays_and_what_is_not_is_not_asked():
    alpha, colour = bands_of_brightness()
    (one, weight), (other, _) = hidden(colour, 1), hidden(colour, 2)
    found = by_examples(one, alpha, weight, ROWS)
    assert np.array_equal(found[:, :, UNSEEN:], colour[:, :, UNSEEN:])
    assert not np.array_equal(one, other)
    assert np.array_equal(found, by_examples(other, alpha, weight, ROWS))


def test_no_colour_is_invented():
    """A mean of colours that are there."""
    rng = np.random.default_rng(5)
    alpha, colour = rng.random((H, W), np.float32), rng.random((3, H, W), np.float32)
    weight = (rng.random((H, W)) > 0.4).astype(np.float32)
    found = by_examples(np.where(weight > 0, colour, -7), alpha, weight, ROWS)
    seen = colour[:, weight > 0]
    assert (found >= seen.min(1)[:, None, None] - 1e-6).all()
    assert (found <= seen.max(1)[:, None, None] + 1e-6).all()


def test_the_surer_a_pixel_is_the_more_it_counts():
    alpha = np.full((H, W), 0.5, np.float32)
    rows = np.broadcast_to((np.arange(H) // 2 % 2 == 0)[:, None], (H, W))
    colour, weight = coloured(rows), np.where(rows, np.float32(0.99), np.float32(0.55))
    weight[:, :UNSEEN] = 0.0
    found = by_examples(colour, alpha, weight, ROWS)[:, 8:-8, 4 : UNSEEN - 4]
    share = (found[0] - BLUE[0]) / (RED[0] - BLUE[0])
    assert share.mean() == pytest.approx(0.99 / (0.99 + 0.55), abs=0.05)


@pytest.mark.parametrize("count", [0, SETTINGS.neighbours - 1])
def test_with_few_seen_pixels_colour_is_returned_as_it_is(count):
    alpha, colour = bands_of_brightness()
    weight = np.zeros((H, W), np.float32)
    weight[0, : 2 * count : 2] = 1.0
    assert np.array_equal(by_examples(colour, alpha, weight, ROWS), colour)
    weight[:] = 1.0
    assert np.array_equal(by_examples(colour, alpha, weight, ROWS), colour)


def test_of_many_seen_pixels_some_are_searched_and_all_unseen_ones_filled(monkeypatch):
    """A large unseen region, of far more seen pixels than are searched."""
    h, w = 480, 640
    bright = np.broadcast_to((np.arange(h) // 32 % 2 == 0)[:, None], (h, w))
    alpha, colour = np.where(bright, np.float32(0.7), np.float32(0.3)), coloured(bright)
    weight = np.ones((h, w), np.float32)
    weight[:, :400] = 0.0
    searched = []
    search = examples.nearest_points
    monkeypatch.setattr(examples, "SETTINGS", replace(SETTINGS, sources=2000))
    monkeypatch.setattr(examples, "nearest_points", lambda x, *of: searched.append(len(x)) or search(x, *of))
    found = by_examples(np.where(weight > 0, colour, np.float32(9)), alpha, weight, ROWS)
    assert len(searched) == 1
    assert 500 < searched[0] <= 2000
    rows = (np.arange(h) % 32 > 3) & (np.arange(h) % 32 < 28)
    assert np.abs(found - colour)[:, rows].max() < 0.05


def test_the_same_is_found_again():
    rng = np.random.default_rng(7)
    alpha = cv2.GaussianBlur(rng.random((H, W), np.float32), (0, 0), 2.0)
    colour, weight = hidden(rng.random((3, H, W), np.float32))
    first, second = (by_examples(colour, alpha, weight, ROWS) for _ in range(2))
    assert np.array_equal(first, second)


def test_fills_of_a_batch_are_of_each_image():
    """Examples of one image serve no other; nor does the regression on brightness for any bands."""
    alpha, colour = (torch.from_numpy(x.copy()) for x in bands_of_brightness())
    weight = torch.from_numpy(hidden(colour.numpy())[1])[None, None].repeat(2, 1, 1, 1)
    both = torch.stack([colour, -colour]), torch.stack([alpha, 1 - alpha])[:, None], weight
    fills = filled_from(*both, ROWS, regressed=True)
    assert fills.shape == (2, 2, 3, H, W)
    for i in range(2):
        one = filled_from(*(part[i : i + 1] for part in both), ROWS, regressed=True)
        assert torch.equal(fills[i : i + 1], one)
    alone = filled_from(*both, ROWS, regressed=False)
    assert alone.shape == (2, 1, 3, H, W)
    by_example = by_examples(colour.numpy(), alpha.numpy(), weight[0, 0].numpy(), ROWS)
    assert np.array_equal(alone[0, 0].numpy(), by_example)
    rows = (torch.arange(H) % 16 > 2) & (torch.arange(H) % 16 < 13)
    for fill in (*fills[0], alone[0, 0]):
        assert (fill - colour)[:, rows, :UNSEEN].abs().mean() < 0.05


def test_examples_along_segments_count_as_nearer():
    """All of one brightness: the unseen middle has a colour 50 pixels along, and one 40 pixels across."""
    alpha, weight = np.full((121, 121), 0.5, np.float32), np.zeros((121, 121), np.float32)
    colour = np.zeros((3, 121, 121), np.float32)
    for (y, x), tint in {(60, 10): RED, (20, 60): BLUE}.items():
        spot = np.s_[y - 4 : y + 5, x - 4 : x + 5]
        weight[spot] = 1.0
        colour[(slice(None), *spot)] = tint[:, None, None]
    middle = (slice(None), 60, 60)
    for directions, along, across in ((ROWS, RED, BLUE), (ROWS[::-1, ::-1], BLUE, RED)):
        tint = by_examples(colour, alpha, weight, directions)[middle]
        assert np.abs(tint - along).max() < np.abs(tint - across).max()
    turned = by_examples(colour.transpose(0, 2, 1), alpha, weight.T, ROWS[::-1, ::-1])
    assert np.abs(turned[middle] - by_examples(colour, alpha, weight, ROWS)[middle]).max() < 1e-5


def test_directions_are_the_valid_segments():
    start, step = torch.zeros(32, 32, 2), torch.tensor([3.0, 4.0])
    valid = torch.arange(32)[:, None].expand(32, 32) < 24
    end = torch.where(valid[..., None], start + step, start - torch.tensor([9.0, 0.0]))
    found = directions_of(Segments(start[None], end[None], valid[None]))
    assert np.abs(found - np.outer([0.6, 0.8], [0.6, 0.8])).max() < 1e-6
    none = directions_of(Segments(start[None], end[None], torch.zeros(1, 32, 32, dtype=torch.bool)))
    assert np.array_equal(none, np.eye(2) / 2)
