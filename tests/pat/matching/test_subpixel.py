"""Matching at full size, around the matches at half the size; and the planes through surfaces."""

import cv2
import numpy as np
import pytest
import torch
from torch.nn.functional import avg_pool2d, interpolate

from arraygeom import Segments, pixel_grid
from pat.matching.inputs import Comparison
from pat.matching.semi_global import matched_at_half_size
from pat.matching.subpixel import SETTINGS, Planes, _runs, _surfaces
from tests.pat.matching.matched_scenes import beside, blurred, matched

H, W, NEAREST = 96, 160, 30
FAR, NEAR = 6, 21
BOX = (slice(21, 70), slice(53, 104))


@pytest.mark.parametrize("half", [np.full((6, 6), 9.0), np.tile([4.0, 4.0, 4.0, 30.0, 30.0, 30.0], (6, 1))])
def test_runs_hold_what_is_nearby_and_do_not_overlap(half):
    low, high = np.moveaxis(_runs(half.astype(np.float32)), -1, 0)
    assert (high >= low + SETTINGS.run).all()
    for value in np.unique(half):
        beside = np.abs(np.arange(12) // 2 - np.flatnonzero(half[0] == value)[:, None]).min(0) <= 2
        held = [
            (first <= value) & (value < first + SETTINGS.run) for first in (low[:, beside], high[:, beside])
        ]
        assert (held[0] | held[1]).all()


def scene() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, Segments, Segments]:
    """A square before a wall, edges between half-size blocks; alpha, beta, disparity, segments, blocks."""
    g = torch.Generator().manual_seed(0)
    wall, square = torch.rand(H, W + 64, generator=g), torch.rand(BOX[0].stop - BOX[0].start, 51, generator=g)
    images = []
    for far, near in ((0, 0), (FAR, NEAR)):
        image = wall[:, 32 + far : 32 + far + W].clone()
        image[BOX[0], BOX[1].start - near : BOX[1].stop - near] = square
        images.append(image[None, None])
    disparity = torch.full((H, W), float(FAR))
    disparity[BOX] = NEAR
    found = []
    for step in (1, 2):
        x = (pixel_grid((H // step, W // step), dtype=torch.float64) + 0.5) * step - 0.5
        start = torch.stack([(x[..., 0] - NEAREST).clamp(min=0), x[..., 1]], -1)
        found.append(Segments(start[None], x[None], torch.ones(1, *x.shape[:-1], dtype=torch.bool)))
    return images[0], images[1], disparity, *found


def test_an_edge_is_found_to_the_pixel():
    alpha, beta, disparity, segments, blocks = scene()
    comparison = Comparison.from_images(alpha, beta)
    half, _ = matched_at_half_size(comparison.half_views(alpha, beta), blocks)
    found, facts = matched(alpha, beta, segments, blocks, comparison)
    near_edge = torch.zeros(H, W, dtype=torch.bool)
    near_edge[BOX[0].start : BOX[0].stop, BOX[1].stop - 4 : BOX[1].stop + 4] = True
    doubled = half[0, 0].repeat_interleave(2, 0).repeat_interleave(2, 1)
    wrong = [float(((d - disparity).abs() > 1)[near_edge].float().mean()) for d in (doubled, found[0, 0])]
    assert wrong[1] < 0.05
    assert wrong[1] < 0.5 * wrong[0]
    occluded = facts[0, 0, 14:32, 24:26]
    assert (occluded > 0.2).float().mean() > 0.8


@pytest.mark.parametrize("disparity", [9.25, 9.6])
def test_a_match_is_found_to_a_tenth_of_a_pixel(disparity):
    """A plane at a fraction of a pixel, in images of one scene at eight times their size."""
    scene = blurred(torch.rand(1, 1, 8 * 64, 8 * 192, generator=torch.Generator().manual_seed(3)), 12.0)
    scene = 0.5 + 0.15 * (scene - scene.mean()) / scene.std()
    shift = round(8 * disparity)
    alpha, beta = (avg_pool2d(scene[..., x : x + 8 * 160], 8) for x in (0, shift))
    _, _, segments = beside(alpha, 0, 160)
    found, _ = matched(alpha, beta, *segments, Comparison.from_images(alpha, beta))
    error = (found - shift / 8)[..., 8:-8, 40:-8]
    assert abs(float(error.mean())) < 0.05
    assert float(error.abs().mean()) < 0.1


def test_a_slope_with_little_texture_is_found_to_a_fraction_of_a_pixel_in_noise():
    """Disparity rises from 8 to 11 pixels; texture is hardly more than the noise of either camera."""
    g = torch.Generator().manual_seed(5)
    x = torch.arange(160.0).expand(96, -1)
    disparity = 8 + x / 53
    scene = blurred(torch.rand(1, 1, 96, 8 * 224, generator=g), 16.0)
    scene = 0.5 + 0.03 * (scene - scene.mean()) / scene.std()
    rows = torch.arange(96)[:, None]
    beta = scene[0, 0, :, 64 : 64 + 8 * 160 : 8]
    # alpha's pixel x shows what beta's shows at x - disparity.
    alpha = scene[0, 0][rows, (64 + 8 * (x - disparity)).round().long().clamp(min=0)]
    images = [p[None, None] + 0.01 * torch.randn(1, 1, 96, 160, generator=g) for p in (alpha, beta)]
    _, _, segments = beside(images[0], 0, 160)
    found, _ = matched(*images, *segments, Comparison.from_images(*images))
    assert float((found[0, 0] - disparity).abs()[8:-8, 24:-8].mean()) < 0.2


def two_slopes() -> tuple[np.ndarray, np.ndarray]:
    """Disparity of two slanted surfaces, the right one 5 pixels nearer; the same with noise."""
    y, x = np.mgrid[:H, :W].astype(np.float32)
    disparity = np.where(x < 81, 8 + x / 20 + y / 30, 18 - x / 25).astype(np.float32)
    noise = np.random.default_rng(0).normal(0, 0.3, disparity.shape)
    return disparity, (disparity + noise).astype(np.float32)


@pytest.mark.parametrize("blur", [0.0, 3.0])
def test_matches_lie_on_slanted_surfaces_and_steps_of_disparity_stay(blur):
    disparity, noisy = two_slopes()
    found = _surfaces(noisy, np.ones_like(noisy), np.zeros(noisy.shape, np.uint8), 0.5 * (1 + blur))
    error = np.abs(found - disparity)
    assert error.mean() < 0.5 * np.abs(noisy - disparity).mean()
    assert np.delete(error[:, 74:88], [6, 7], 1).max() < 1.5 + blur  # planes are of every second pixel
    assert error[8:-8, 8:70].mean() < (0.1 if blur else 0.15)


def test_a_match_that_counts_little_takes_the_place_of_those_around():
    disparity, noisy = two_slopes()
    wrong = (slice(40, 48), slice(30, 40))
    noisy[wrong] += 3
    weight = np.ones_like(noisy)
    weight[wrong] = 1e-5
    found = _surfaces(noisy, weight, np.zeros(noisy.shape, np.uint8), 4.0)
    assert np.abs(found - disparity)[wrong].mean() < 0.3


def test_a_blurred_beta_is_matched_to_a_pixel():
    """Disparity of a slope, beta reduced 8 times and enlarged: one of its pixels is 8 of alpha's."""
    g = torch.Generator().manual_seed(7)
    scene = blurred(torch.rand(1, 1, 192, 8 * 512, generator=g), 24.0)
    scene = 0.5 + 0.15 * (scene - scene.mean()) / scene.std()
    x = torch.arange(384.0).expand(192, -1)
    disparity = 16 + x / 48
    rows, start = torch.arange(192)[:, None], 8 * 64
    beta = scene[..., start : start + 8 * 384 : 8]
    alpha = scene[0, 0][rows, (start + 8 * (x - disparity)).round().long().clamp(min=0)][None, None]
    coarse = interpolate(avg_pool2d(beta, 8), scale_factor=8, mode="bicubic", align_corners=False)
    _, _, segments = beside(alpha, 0, 384)
    found, _ = matched(alpha, coarse, *segments, Comparison.from_images(alpha, coarse))
    assert float(((found[0, 0] - disparity).abs()[16:-16, 64:-16] < 1).float().mean()) > 0.78


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
    whole = whole[: H - 1, : W - 1]
    values = whole[::2, ::2]
    planes = Planes.through(values, np.ones_like(values), np.zeros((*values.shape, 1), np.float32), 24.0)
    error = np.abs(planes.at_pixels((H - 1, W - 1)) - whole)
    assert error[30:-30, 30:-30].max() < 0.02


def test_an_edge_of_the_guide_parts_planes():
    _, values = whole_and_every_second(0.05, 0.0)
    step = np.where(np.arange(W // 2) < 40, 0, 7).astype(np.float32)
    guide = np.broadcast_to(step / 7 * 50, values.shape)[..., None].astype(np.float32)
    planes = Planes.through(values + step, np.ones_like(values), guide, 24.0)
    assert np.abs(planes.value - values - step).max() < 0.2
