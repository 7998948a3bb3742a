"""log_sum and mean_score against the formula with everything gathered, values and gradients."""

from __future__ import annotations

import pytest
import torch

from arraygeom import Positions, Segments
from pat.attention import reference
from pat.attention.attend import sample_positions
from pat.attention.scores import Compared, log_sum, mean_score, peak_position

SAMPLES = 9


def compared(interpolation="bilinear", *, seed=0, dtype=torch.float64, batch=2) -> Compared:
    """Random features, segments of which some leave beta, and one pixel without any."""
    g = torch.Generator().manual_seed(seed)
    query = torch.randn(batch, 5, 4, 6, generator=g, dtype=dtype, requires_grad=True)
    key = torch.randn(batch, 5, 7, 8, generator=g, dtype=dtype, requires_grad=True)
    start, end = (torch.rand(2, batch, 4, 6, 2, generator=g, dtype=dtype) * 9 - 1).unbind(0)
    valid = torch.ones(batch, 4, 6, dtype=torch.bool)
    valid[0, 0, 0] = False
    return Compared(query, key, key, Segments(start, end, valid), SAMPLES, interpolation)


def gathered(one: Compared) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """All scores (b, h, w, l), which of them count, and the positions."""
    form = sample_positions(one.segments, one.query, one.samples)
    xy = form.positions()
    counts = form.mask & reference.on_image(xy, hw=one.key.shape[2:])
    at = reference._nearest if one.interpolation == "nearest" else reference._bilinear
    keys = at(one.key.permute(0, 2, 3, 1), torch.where(counts[..., None], xy, 0))
    return torch.einsum("bdrw,brwld->brwl", one.query, keys), counts, xy


@pytest.mark.parametrize("interpolation", ["bilinear", "nearest"])
def test_log_sum_and_mean_score_are_the_formula_in_value_and_gradient(interpolation):
    one = compared(interpolation)
    scores, counts, _ = gathered(one)
    some = counts.any(-1)
    cotangent = torch.randn(some.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    wanted = {
        log_sum: torch.where(counts, scores, -torch.inf)[some].logsumexp(-1),
        mean_score: (torch.where(counts, scores, 0).sum(-1)[some] / counts.sum(-1)[some]),
    }
    for function, expected in wanted.items():
        found = function(one)
        torch.testing.assert_close(found[some], expected, rtol=1e-10, atol=1e-10)
        ours = torch.autograd.grad((found * cotangent)[some].sum(), [one.query, one.key])
        loss = (expected * cotangent[some]).sum()
        theirs = torch.autograd.grad(loss, [one.query, one.key], retain_graph=True)
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)


def test_the_log_sum_is_the_formula_where_no_backend_is_compiled():
    one = compared()
    segments = Segments(*(getattr(one.segments, name).to("meta") for name in ("start", "end", "valid")))
    query, key = one.query.to("meta"), one.key.to("meta")
    assert log_sum(one._replace(query=query, key=key, locations=segments)).shape == (2, 4, 6)


def test_a_second_derivative_of_the_log_sum_is_refused():
    one = compared("bilinear")
    (first,) = torch.autograd.grad(log_sum(one).square().sum(), one.query, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        first.sum().backward()


def test_pixels_without_samples_pass_no_gradient():
    one = compared()
    by_query = torch.autograd.grad(log_sum(one)[0, 0, 0], one.query)[0]
    assert not by_query.any()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_peak_is_where_the_largest_score_is(dtype):
    one = compared(dtype=dtype)
    scores, counts, xy = gathered(one)
    best = torch.where(counts, scores, -torch.inf).argmax(-1)
    expected = xy.gather(-2, best[..., None, None].expand(*best.shape, 1, 2))[..., 0, :]
    some = counts.any(-1)
    found = peak_position(one).movedim(1, -1)
    torch.testing.assert_close(found[some], expected[some].float(), rtol=0, atol=1e-3)


def test_strided_is_every_other_pixel():
    one = compared()
    torch.testing.assert_close(log_sum(one.strided(2)), log_sum(one)[:, ::2, ::2])


def test_explicit_positions_are_refused_by_what_needs_segments():
    one = compared()._replace(
        locations=lambda x: Positions(x[:, None], torch.ones(len(x), 1, dtype=torch.bool))
    )
    with pytest.raises(ValueError, match="straight"):
        one.strided(2)


def test_a_key_of_other_channels_is_refused():
    one = compared()
    with pytest.raises(ValueError, match="batch and channels"):
        log_sum(one._replace(key=one.key[:, :2]))
