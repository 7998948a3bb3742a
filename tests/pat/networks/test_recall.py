"""Colour by example: what alpha looks alike to has its colour, wherever it is."""

import pytest
import torch
from torch.nn.functional import avg_pool2d

from pat.networks.recall import FIELD, SETTINGS, fitted, nearness, recalled, smoothed_within, with_less_noise

HW = (64, 160)
RED, BLUE = torch.tensor([0.3, -0.1, -0.1]), torch.tensor([-0.1, -0.1, 0.3])


@pytest.fixture(scope="module")
def stripes():
    """Alpha with stripes of two directions, each direction a colour; what is at the left is not seen."""
    y, x = torch.meshgrid(torch.arange(HW[0]), torch.arange(HW[1]), indexing="ij")
    upright = (y // 16) % 2 == 0
    alpha = 0.5 + 0.3 * torch.where(upright, (x % 8 < 4) * 2 - 1, (y % 8 < 4) * 2 - 1)
    colour = torch.where(upright, RED[:, None, None], BLUE[:, None, None])
    confidence = (x >= 40).float().expand(3, *HW)
    return alpha[None, None].float(), colour[None], confidence[None]


def test_colour_is_that_of_what_looks_alike(stripes):
    alpha, colour, confidence = stripes
    hidden = torch.where(confidence > 0, colour, torch.rand_like(colour))
    found, expected = recalled(alpha, hidden, confidence)[..., :10], avg_pool2d(colour, 2)[..., :10]
    assert found.shape == expected.shape
    assert (found - expected).abs().mean() < 0.04
    assert (found - expected.flip(1)).abs().mean() > 0.2
    nearest = colour[..., 40:41].mean(-2, keepdim=True).expand_as(expected)
    assert (found - expected).abs().mean() < 0.3 * (nearest - expected).abs().mean()


def test_a_pixel_counts_where_all_bands_are_certain(stripes):
    """Bands of several betas: one of them is wrong, and known to be, in the nearer part."""
    alpha, colour, confidence = stripes
    wrong, doubted = colour.clone(), confidence.clone()
    wrong[:, :1, :, 40:80], doubted[:, :1, :, 40:80] = 1.0, 0.0
    found = recalled(alpha, wrong, doubted)[..., :10]
    assert (found - avg_pool2d(colour, 2)[..., :10]).abs().mean() < 0.04


def test_nearer_pixels_count_more():
    near = nearness().view(FIELD.size, FIELD.size)
    middle = FIELD.size // 2
    assert near[middle, middle] == near.max() == 0
    off = SETTINGS.spacing / SETTINGS.distance
    assert near[middle, middle + 1] == pytest.approx(-off)
    assert near[0, 0] == pytest.approx(-off * middle * 2**0.5)


def test_far_pixels_are_looked_at_half_as_densely():
    near = nearness().view(FIELD.size, FIELD.size)
    middle, reach = FIELD.size // 2, SETTINGS.side // 2
    inner = near[middle - reach : middle + reach + 1, middle - reach : middle + reach + 1]
    assert inner.isfinite().all()
    assert near[::2, ::2].isfinite().all()
    assert near.isfinite().sum() == 2 * SETTINGS.side**2 - (reach + 1) ** 2


def test_gradients_reach_alpha_and_colour(stripes):
    alpha, colour, confidence = (part[..., :32, :64].double().clone().requires_grad_() for part in stripes)
    fitted(recalled(alpha, colour, confidence), alpha, colour, confidence)[..., :16].square().sum().backward()
    assert all(
        part.grad.isfinite().all() and part.grad.abs().max() > 0 for part in (alpha, colour, confidence)
    )


@pytest.fixture
def halves():
    """Alpha of two levels beside each other, each of a colour, which is noisy."""
    right = torch.arange(HW[1]).expand(*HW) >= 80
    alpha = torch.where(right, 0.6, 0.4)[None, None]
    colour = torch.where(right, RED[:, None, None], BLUE[:, None, None])[None]
    return alpha, colour, colour + 0.05 * torch.randn(1, 3, *HW, generator=torch.Generator().manual_seed(0))


def test_smoothing_stays_within_what_is_alike(halves):
    alpha, colour, noisy = halves
    for part, same, spacings in (
        (noisy, colour, SETTINGS.last),
        (avg_pool2d(noisy, 2), avg_pool2d(colour, 2), SETTINGS.rounds),
    ):
        smooth = smoothed_within(alpha, part, spacings)
        assert (smooth - same).square().mean() < 0.05 * (part - same).square().mean()
        flat = smoothed_within(torch.full_like(alpha, 0.5), part, spacings)
        assert (flat - same).abs().max() > 0.1


def test_what_is_certain_counts_more_and_is_left_alone(halves):
    alpha, colour, noisy = halves
    certain = torch.zeros_like(noisy)
    certain[..., ::2] = 1.0
    mixed = torch.where(certain > 0, colour, noisy)
    weighted, equally = (smoothed_within(alpha, mixed, SETTINGS.last, by) for by in (certain, None))
    assert (weighted - colour).square().mean() < 0.1 * (equally - colour).square().mean()
    less = with_less_noise(alpha, mixed, certain)
    assert torch.equal(less[certain > 0], mixed[certain > 0])
    assert torch.allclose(less[certain == 0], weighted[certain == 0])
    half = with_less_noise(alpha, mixed, torch.full_like(mixed, 0.5))
    assert torch.allclose(half, (mixed + equally) / 2, atol=1e-5)


def test_what_is_filled_in_is_smoothed_with_what_is_certain(halves):
    alpha, colour, _ = halves
    certain = torch.ones_like(alpha)
    certain[..., 60:80] = 0.0
    filled = torch.zeros_like(avg_pool2d(colour, 2))
    found = fitted(filled, alpha, colour, certain)
    assert torch.allclose(found[..., 84:], colour[..., 84:], atol=1e-3)
    hole, truth = found[..., 62:78], colour[..., 62:78]
    assert (hole - truth).norm() < 0.7 * truth.norm()
    assert (hole - truth).norm() < (hole - colour[..., -1:]).norm()
