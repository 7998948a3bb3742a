"""Colour by example: what alpha looks alike to has its colour, wherever it is."""

import pytest
import torch

from pat.networks.recall import SETTINGS, nearness, recalled

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
    found, expected = recalled(alpha, hidden, confidence)[..., :20], colour[..., :20]
    assert found.shape == expected.shape
    assert (found - expected).abs().mean() < 0.03
    assert (found - expected.flip(1)).abs().mean() > 0.2
    nearest = colour[..., 40:41].mean(-2, keepdim=True).expand_as(expected)
    assert (found - expected).abs().mean() < 0.2 * (nearest - expected).abs().mean()


def test_a_pixel_counts_where_all_bands_are_certain(stripes):
    """Bands of several betas: one of them is wrong, and known to be, in the nearer part."""
    alpha, colour, confidence = stripes
    wrong, doubted = colour.clone(), confidence.clone()
    wrong[:, :1, :, 40:80], doubted[:, :1, :, 40:80] = 1.0, 0.0
    found = recalled(alpha, wrong, doubted)[..., :20]
    assert (found - colour[..., :20]).abs().mean() < 0.03


def test_nearer_pixels_count_more():
    near = nearness().view(SETTINGS.side, -1)
    middle = SETTINGS.side // 2
    assert near[middle, middle] == near.max() == 0
    off = SETTINGS.spacing / SETTINGS.distance
    assert near[middle, middle + 1] == pytest.approx(-off)
    assert near[0, 0] == pytest.approx(-off * middle * 2**0.5)


def test_gradients_reach_alpha_and_colour(stripes):
    alpha, colour, confidence = (part[..., :32, :64].double().clone().requires_grad_() for part in stripes)
    recalled(alpha, colour, confidence)[..., :16].square().sum().backward()
    assert all(
        part.grad.isfinite().all() and part.grad.abs().max() > 0 for part in (alpha, colour, confidence)
    )
