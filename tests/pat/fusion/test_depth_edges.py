"""Depth beside its edges is that of pixels that look alike."""

import numpy as np
import pytest
import torch

from arraygeom import Segments
from arraygeom.fields.grid import FieldOnGrid
from pat.fusion import depth_edges
from pat.fusion.depth_edges import SETTINGS, beside_edges
from pat.fusion.frame import Frame
from pat.fusion.inputs import FrameInputs
from pat.matching.inputs import Beta, Inputs

HALF_WIDTH = 0.005


def given(alpha, around=False):
    end = torch.zeros(1, *alpha.shape, 2)
    segments = Segments(end + 1, end, torch.ones(1, *alpha.shape, dtype=torch.bool))
    beta = Beta(torch.zeros(1, 1, *alpha.shape), FieldOnGrid(lambda x: segments, 2, segments), around=around)
    return FrameInputs(Inputs(alpha[None, None], (beta,)), [], tuple(alpha.shape))


def found(depth, alpha, confidence=None, **how):
    ones = torch.ones_like(depth)
    confidence = ones if confidence is None else confidence
    frame = Frame(torch.zeros(1, *depth.shape), depth, confidence, HALF_WIDTH * ones)
    return beside_edges(depth, frame, given(alpha, **how))


def misplaced():
    """A post 2 m away before a wall at 5 m, in alpha two pixels to the left of where it is in depth."""
    wanted, alpha = torch.full((40, 60), 5.0), torch.full((40, 60), 0.3)
    wanted[:, 20:32], alpha[:, 20:32] = 2.0, 0.8
    return wanted.roll(2, 1), alpha, wanted


@pytest.mark.parametrize("turned", [False, True])
def test_edges_of_depth_are_those_of_alpha(turned):
    depth, alpha, wanted = (t.mT if turned else t for t in misplaced())
    assert torch.equal(found(depth, alpha), wanted)


def test_thin_things_stay_and_even_ones_are_as_they_were():
    depth, alpha = torch.full((40, 60), 5.0), torch.full((40, 60), 0.3)
    depth[:, 30:32], alpha[:, 30:32] = 2.0, 0.8
    assert torch.equal(found(depth, alpha), depth)
    slope = 1 / (0.2 + 0.001 * torch.arange(60.0)).repeat(40, 1)
    assert torch.equal(found(slope, alpha), slope)


def test_what_is_taken_is_the_weighted_median():
    g = torch.Generator().manual_seed(0)
    depth, alpha = 1 / (0.2 + torch.rand(14, 17, generator=g)), torch.rand(14, 17, generator=g)
    depth[3, 4] = torch.nan
    taken, r = found(depth, alpha), SETTINGS.radius
    for y, x in ((0, 0), (7, 8), (13, 16), (2, 3)):
        part = slice(max(y - r, 0), y + r + 1), slice(max(x - r, 0), x + r + 1)
        values, grey = (1 / depth[part]).flatten(), alpha[part].flatten()
        apart = ((grey - alpha[y, x]).abs() * 255).floor() / 255
        weight = torch.where(values.isfinite(), (-((apart / SETTINGS.alike) ** 2) / 2).exp(), 0.0)
        order = values.nan_to_num(torch.inf).argsort()
        middle = int((weight[order].cumsum(0) >= weight.sum() / 2).nonzero()[0])
        assert float(1 / taken[y, x]) == pytest.approx(float(values[order[middle]]), abs=5e-4)


def test_what_is_not_known_stays_so_and_is_not_taken():
    depth, alpha, wanted = misplaced()
    depth[5:9, 20:22] = torch.nan
    assert torch.equal(found(depth, alpha).isnan(), depth.isnan())
    known = depth.isfinite()
    assert torch.equal(found(depth, alpha)[known], wanted[known])


def test_gradients_are_those_of_the_pixel_that_is_taken():
    depth, alpha, _ = misplaced()
    depth.requires_grad_()
    found(depth, alpha)[:, 20].sum().backward()
    assert depth.grad[:, 22:32].sum() == 40
    assert depth.grad.sum() == 40


def test_depth_in_parts_is_that_of_the_whole(monkeypatch):
    g = torch.Generator().manual_seed(0)
    depth, alpha = 1 / (0.2 + torch.rand(90, 30, generator=g)), torch.rand(90, 30, generator=g)
    whole = found(depth, alpha)
    monkeypatch.setattr(depth_edges, "ROWS", 32)
    assert torch.equal(found(depth, alpha), whole)


def test_depth_stays_where_it_was_known_or_its_interval_is_not():
    depth, alpha, _ = misplaced()
    assert torch.equal(found(depth, alpha, around=True), depth)
    assert torch.equal(found(depth, alpha, confidence=torch.zeros_like(depth)), depth)
    frame = Frame(torch.zeros(1, *depth.shape), depth, torch.ones_like(depth), depth * np.nan)
    assert torch.equal(beside_edges(depth, frame, given(alpha)), depth)
