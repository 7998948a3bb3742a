"""Gradients of where matches are: positions follow images and segments as the best agreement does."""

import math

import numpy as np
import pytest
import torch

from arraygeom import Segments, pixel_grid
from pat.matching.normalisation import ComparedViews
from pat.matching.subpixel import _step, with_gradients

H, W, DISPARITY = 40, 64, 7.0
INSIDE = (..., slice(12, -12), slice(20, -12))


def looked_at(where: torch.Tensor, seed: int = 0) -> torch.Tensor:
    """A smooth scene at positions (H, W, 2): waves of 9 to 30 pixels, (1, 1, H, W)."""
    g = torch.Generator().manual_seed(seed)
    angle, phase = 2 * math.pi * torch.rand(2, 24, generator=g, dtype=torch.float64)
    count = 2 * math.pi / torch.linspace(9, 30, 24, dtype=torch.float64)
    wave = count * torch.stack([angle.cos(), angle.sin()])
    return 0.5 + (0.03 * torch.sin(where @ wave + phase)).sum(-1)[None, None]


def rows(moved: torch.Tensor, slope: torch.Tensor | float = 0.0) -> Segments:
    """Rows of 20 pixels that end at alpha's pixels, or `moved` farther right and at a slope."""
    x = pixel_grid((H, W), dtype=torch.float64)[None]
    end = x + torch.stack([moved, 0 * moved])
    towards = torch.stack([-torch.ones((), dtype=torch.float64), torch.as_tensor(slope, dtype=torch.float64)])
    return Segments(end + 20 * towards / towards.norm(), end, torch.ones(1, H, W, dtype=torch.bool))


def views(shift: torch.Tensor) -> ComparedViews:
    x = pixel_grid((H, W), dtype=torch.float64)
    beta = looked_at(x + torch.stack([DISPARITY + shift, 0 * shift]))
    return ComparedViews(looked_at(x), beta, np.zeros((1, H, W), np.uint8), [0.0])


def found(moved: torch.Tensor, shift: torch.Tensor, slope: torch.Tensor | float = 0.0) -> torch.Tensor:
    """Disparity of a flat scene, truly DISPARITY, with beta `shift` to the left and segments `moved`."""
    truth = torch.full((1, 1, H, W), DISPARITY, dtype=torch.float64)
    return with_gradients(views(shift), rows(moved, slope), truth)


def zero(*, grad: bool = False) -> torch.Tensor:
    return torch.zeros((), dtype=torch.float64, requires_grad=grad)


def test_matches_stay_where_they_are_if_segments_move_along_themselves():
    moved = zero(grad=True)
    disparity = found(moved, zero())
    assert torch.equal(disparity.detach(), torch.full_like(disparity, DISPARITY))
    (slope,) = torch.autograd.grad(disparity[INSIDE].mean(), moved)
    assert slope.item() == pytest.approx(1.0, abs=0.1)


def test_matches_follow_betas_content():
    shift = zero(grad=True)
    (slope,) = torch.autograd.grad(found(zero(), shift)[INSIDE].mean(), shift)
    assert slope.item() == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("at", [(15, 30), (20, 40), (24, 25), (20, 33)])
def test_gradients_are_those_of_the_best_agreement(at):
    """Against differences of where repeated steps end, for segments that turn: content crosses them, too."""
    seen, here = views(zero()), (0, 0, *at)

    def settled(slope: float) -> float:
        disparity = torch.full((1, 1, H, W), DISPARITY, dtype=torch.float64)
        for _ in range(30):
            disparity = disparity + _step(seen, rows(zero(), slope), disparity)[here]
        return float(disparity[here])

    slope = zero(grad=True)
    (gradient,) = torch.autograd.grad(found(zero(), zero(), slope)[here], slope)
    difference = (settled(1e-4) - settled(-1e-4)) / 2e-4
    assert abs(difference) > 0.1
    assert gradient.item() == pytest.approx(difference, rel=0.05)
