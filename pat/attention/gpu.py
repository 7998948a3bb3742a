"""C3 attention on GPUs, in Triton: one program for a few alpha pixels, channels along its lanes.

Forward walks the samples once with a running softmax, backward once more for the gradients: the mean of the
gradients by the weights, which all of them need, follows from forward's outputs (as in FlashAttention-2; Dao
2023, section 3.1). With the gradients g by the value, (a, b) by the position, s by the spread and k by the
peak, a sample's weight has the gradient g.v + a x + b y + s |(x, y) - position|^2 / (2 spread) + k [it is the
best]; the mean of this over the weights is g.out + (a, b).position + s spread / 2 + k peak.

Beta's gradients are added to with atomics of float32, in no fixed order.
`TRITON_INTERPRET=1`, set before the first import, runs the same code on the CPU, for tests.
"""

from __future__ import annotations

from collections.abc import Sequence
from inspect import unwrap

import torch
import triton
import triton.language as tl
from torch import Tensor

from arraygeom.sampling import SLACK as EDGE_SLACK
from arraygeom.segments import sample_fractions
from pat.attention.reference import LEAST_DEVIATION, AttentionInputs, accumulated, channels_last

PIXELS = 8
"""Alpha pixels of one program."""
LEAST = tl.constexpr(LEAST_DEVIATION)
SLACK = tl.constexpr(EDGE_SLACK)


def forward(inputs: AttentionInputs, measured: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Compute attention as `cpu.forward`, on the GPU.

    Returns:
        As `cpu.forward`, but last the number of the sample of largest weight (b, ha, wa), int32; 0 where none
        counts.
    """
    query = inputs.query
    b, _, ha, wa = query.shape
    counted = accumulated(query)
    out = query.new_empty(b, ha, wa, inputs.value.shape[1])
    statistics = query.new_empty(b, ha, wa, 4, dtype=counted)
    logsum = query.new_empty(b, ha, wa, dtype=counted)
    best = query.new_empty(b, ha, wa, dtype=torch.int32)
    tensors, options = _call(inputs)
    _forward[_programs(query)](*tensors, out, statistics, logsum, best, **options)
    return out.permute(0, 3, 1, 2), statistics if measured else statistics.new_empty(0), logsum, best


def backward(
    inputs: AttentionInputs,
    saved: tuple[Tensor, Tensor, Tensor, Tensor],
    cotangents: tuple[Tensor, Tensor],
    wanted: Sequence[bool],
) -> tuple[Tensor, ...]:
    """Differentiate `forward` as `cpu.backward`, on the GPU.

    Args:
        saved: results of `forward`: statistics, log sums, samples of largest weight, and values.
        cotangents: gradients by values and statistics.
        wanted: five flags, True for a gradient to compute.

    Returns:
        Five gradients as `cpu.backward` returns them; by key and value they are summed in no fixed order.
    """
    query, key, value, positions, *_ = inputs
    b, _, ha, wa = query.shape
    counted = accumulated(query)
    upstream = channels_last(cotangents[0])
    statistics, statistics_upstream = (
        t.contiguous() if t.numel() else t.new_zeros(b, ha, wa, 4)
        for t in (saved[0], cotangents[1].to(counted))
    )
    images = [t.new_zeros(b, *t.shape[2:], t.shape[1], dtype=counted) for t in (key, value)]
    query_out = query.new_empty(b, ha, wa, query.shape[1])
    points_out = query.new_zeros(b, *positions.points.shape[1:], dtype=counted)
    bias_out = query.new_zeros((b, ha, wa, positions.samples) if wanted[4] else 1, dtype=counted)
    tensors, options = _call(inputs)
    _backward[_programs(query)](
        *tensors,
        *(statistics, saved[1], saved[2], channels_last(saved[3]), upstream, statistics_upstream),
        *(query_out, *images, points_out, bias_out),
        **options,
        WANTS_BIAS=wanted[4],
    )
    key_out, value_out = (t.to(query.dtype).permute(0, 3, 1, 2) for t in images)
    points_out = points_out.sum_to_size(positions.points.shape)
    gradients = query_out.permute(0, 3, 1, 2), key_out, value_out, points_out, bias_out
    return tuple(t if want else t.new_empty(0) for t, want in zip(gradients, wanted))


def _programs(query: Tensor) -> tuple[int]:
    return (triton.cdiv(query.shape[0] * query.shape[2] * query.shape[3], PIXELS),)


def _call(inputs: AttentionInputs) -> tuple:
    query, key, value, positions, bias, nearest = inputs
    counted = accumulated(query)
    tensors = (
        *(channels_last(t) for t in (query, key, value)),
        positions.points.contiguous(),
        positions.mask.contiguous().view(torch.uint8),
        sample_fractions(positions.samples, like=positions.points),
        query.new_zeros(1, dtype=counted) if bias is None else bias.to(counted).contiguous(),
        query.shape[0] * query.shape[2] * query.shape[3],
        query.shape[2] * query.shape[3],
        *key.shape[2:],
        positions.samples,
    )
    options = {
        "D": query.shape[1],
        "DV": value.shape[1],
        "D_BLOCK": triton.next_power_of_2(query.shape[1]),
        "DV_BLOCK": triton.next_power_of_2(value.shape[1]),
        "PIXELS": PIXELS,
        "SHARED": positions.points.shape[0] == 1,
        "STRAIGHT": positions.straight,
        "NEAREST": nearest,
        "BIASED": bias is not None,
        "NUMBER": tl.float64 if counted == torch.float64 else tl.float32,
    }
    return tensors, options


def compiled(function):
    """Compile a function by triton.jit, without the type checker that tests wrap around it."""
    return triton.jit(unwrap(function))


@compiled
def _sample(points, mask, fractions, place, alive, height, width, i, samples, STRAIGHT):
    """Position (x, y) of sample i of some pixels, and True where it counts."""
    if STRAIGHT:
        x0 = tl.load(points + 4 * place, mask=alive, other=0)
        y0 = tl.load(points + 4 * place + 1, mask=alive, other=0)
        u = tl.load(fractions + i)
        x = x0 + u * (tl.load(points + 4 * place + 2, mask=alive, other=0) - x0)
        y = y0 + u * (tl.load(points + 4 * place + 3, mask=alive, other=0) - y0)
        counts = alive & (tl.load(mask + place, mask=alive, other=0) != 0)
    else:
        index = place * samples + i
        x = tl.load(points + 2 * index, mask=alive, other=0)
        y = tl.load(points + 2 * index + 1, mask=alive, other=0)
        counts = alive & (tl.load(mask + index, mask=alive, other=0) != 0)
    counts = counts & (x >= -0.5 - SLACK) & (x <= width - 0.5 + SLACK)
    counts = counts & (y >= -0.5 - SLACK) & (y <= height - 0.5 + SLACK)
    return tl.where(counts, x, 0), tl.where(counts, y, 0), counts


@compiled
def _cell(x, y, height, width, NEAREST):
    """The four pixels around (x, y), as offsets from the first, and the fractions of the way between them."""
    if NEAREST:
        right = tl.minimum(tl.maximum(tl.floor(x + 0.5).to(tl.int64), 0), width - 1)
        down = tl.minimum(tl.maximum(tl.floor(y + 0.5).to(tl.int64), 0), height - 1)
        return down * width + right, 0 * right, 0 * right, 0 * x, 0 * y
    x = tl.minimum(tl.maximum(x, 0), width - 1)
    y = tl.minimum(tl.maximum(y, 0), height - 1)
    right = tl.minimum(x.to(tl.int64), tl.maximum(width - 2, 0))
    down = tl.minimum(y.to(tl.int64), tl.maximum(height - 2, 0))
    across = tl.minimum(width - 1, 1) + 0 * right
    below = tl.minimum(height - 1, 1) * width + 0 * right
    return down * width + right, across, below, x - right.to(x.dtype), y - down.to(x.dtype)


@compiled
def _rows(image, pixel, channel, D, live, NUMBER):
    return tl.load(image + pixel[:, None] * D + channel[None, :], mask=live, other=0).to(NUMBER)


@compiled
def _dots(x, image, pixel, across, below, channel, D, live, NEAREST, NUMBER):
    """Inner products with the four pixels around (with one, four times, if nearest)."""
    a = tl.sum(x * _rows(image, pixel, channel, D, live, NUMBER), 1)
    if NEAREST:
        return a, a, a, a
    b = tl.sum(x * _rows(image, pixel + across, channel, D, live, NUMBER), 1)
    c = tl.sum(x * _rows(image, pixel + below, channel, D, live, NUMBER), 1)
    d = tl.sum(x * _rows(image, pixel + across + below, channel, D, live, NUMBER), 1)
    return a, b, c, d


@compiled
def _blend(a, b, c, d, u, v):
    upper = a + u * (b - a)
    lower = c + u * (d - c)
    return upper + v * (lower - upper)


@compiled
def _blended(image, pixel, across, below, u, v, channel, D, live, NEAREST, NUMBER):
    """Image values at the samples."""
    a = _rows(image, pixel, channel, D, live, NUMBER)
    if NEAREST:
        return a
    b = _rows(image, pixel + across, channel, D, live, NUMBER)
    c = _rows(image, pixel + below, channel, D, live, NUMBER)
    d = _rows(image, pixel + across + below, channel, D, live, NUMBER)
    return _blend(a, b, c, d, u[:, None], v[:, None])


@compiled
def _places(pixels, alpha_pixels, height, width, PIXELS: tl.constexpr, SHARED):
    """Indices of some alpha pixels, which of them exist, the place of their geometry, and beta's
    first pixel."""
    p = tl.program_id(0).to(tl.int64) * PIXELS + tl.arange(0, PIXELS)
    place = p % alpha_pixels if SHARED else p
    return p, p < pixels, place, p // alpha_pixels * height * width


@compiled
def _update(x, y, w, keep, mass, mean_x, mean_y, squared, NUMBER):
    """Running sums (mass, mean position, squared distances) after one more sample of weight w, with earlier
    ones multiplied by `keep`."""
    mass = mass * keep + w
    share = tl.where(mass > 0, w / tl.where(mass > 0, mass, 1.0), 0.0).to(NUMBER)
    dx, dy = x - mean_x, y - mean_y
    mean_x += share * dx
    mean_y += share * dy
    return mass, mean_x, mean_y, squared * keep + w * (dx * (x - mean_x) + dy * (y - mean_y))


@compiled
def _forward(
    query,
    key,
    value,
    points,
    mask,
    fractions,
    bias,
    pixels,
    alpha_pixels,
    height,
    width,
    samples,
    out,
    statistics,
    logsum,
    best_out,
    D: tl.constexpr,
    DV: tl.constexpr,
    D_BLOCK: tl.constexpr,
    DV_BLOCK: tl.constexpr,
    PIXELS: tl.constexpr,
    SHARED: tl.constexpr,
    STRAIGHT: tl.constexpr,
    NEAREST: tl.constexpr,
    BIASED: tl.constexpr,
    NUMBER: tl.constexpr,
):
    p, alive, place, first = _places(pixels, alpha_pixels, height, width, PIXELS, SHARED)
    c, cv = tl.arange(0, D_BLOCK), tl.arange(0, DV_BLOCK)
    q = _rows(query, p, c, D, alive[:, None] & (c < D)[None, :], NUMBER)
    top = tl.full([PIXELS], float("-inf"), NUMBER)
    best = tl.zeros([PIXELS], tl.int32)
    mass, squared = tl.zeros([PIXELS], NUMBER), tl.zeros([PIXELS], NUMBER)
    mean_x, mean_y = tl.zeros([PIXELS], NUMBER), tl.zeros([PIXELS], NUMBER)
    accumulated = tl.zeros([PIXELS, DV_BLOCK], NUMBER)
    for i in range(samples):
        x, y, counts = _sample(points, mask, fractions, place, alive, height, width, i, samples, STRAIGHT)
        pixel, across, below, u, v = _cell(x, y, height, width, NEAREST)
        live = counts[:, None] & (c < D)[None, :]
        s0, s1, s2, s3 = _dots(q, key, first + pixel, across, below, c, D, live, NEAREST, NUMBER)
        score = _blend(s0, s1, s2, s3, u, v)
        if BIASED:
            score += tl.load(bias + p * samples + i, mask=alive, other=0)
        score = tl.where(counts, score, float("-inf"))
        new_top = tl.maximum(top, score)
        base = tl.where(new_top == float("-inf"), 0.0, new_top).to(NUMBER)
        keep, w = tl.exp(top - base), tl.exp(score - base)
        live = counts[:, None] & (cv < DV)[None, :]
        row = _blended(value, first + pixel, across, below, u, v, cv, DV, live, NEAREST, NUMBER)
        accumulated = accumulated * keep[:, None] + w[:, None] * row
        mass, mean_x, mean_y, squared = _update(x, y, w, keep, mass, mean_x, mean_y, squared, NUMBER)
        best = tl.where(score > top, i, best)
        top = new_top
    some = mass > 0
    whole = tl.where(some, mass, 1.0).to(NUMBER)
    spread = tl.sqrt(tl.maximum(squared / whole, 0.0))
    tl.store(statistics + 4 * p, tl.where(some, mean_x, 0.0), mask=alive)
    tl.store(statistics + 4 * p + 1, tl.where(some, mean_y, 0.0), mask=alive)
    tl.store(statistics + 4 * p + 2, tl.where(some & (spread > LEAST), spread, 0.0), mask=alive)
    tl.store(statistics + 4 * p + 3, tl.where(some, 1.0 / whole, 0.0), mask=alive)
    tl.store(logsum + p, tl.where(some, top + tl.log(whole), float("-inf")), mask=alive)
    tl.store(best_out + p, best, mask=alive)
    live = alive[:, None] & (cv < DV)[None, :]
    accumulated = accumulated / whole[:, None]
    tl.store(out + p[:, None] * DV + cv[None, :], accumulated.to(out.dtype.element_ty), mask=live)


@compiled
def _add(out, pixel, weight, x, channel, D, live):
    """Add weight x to pixels of an image."""
    tl.atomic_add(out + pixel[:, None] * D + channel[None, :], weight[:, None] * x, mask=live)


@compiled
def _add_around(out, pixel, across, below, u, v, weight, x, channel, D, live, NEAREST):
    if NEAREST:
        _add(out, pixel, weight, x, channel, D, live)
    else:
        _add(out, pixel, weight * (1 - u) * (1 - v), x, channel, D, live)
        _add(out, pixel + across, weight * u * (1 - v), x, channel, D, live)
        _add(out, pixel + below, weight * (1 - u) * v, x, channel, D, live)
        _add(out, pixel + across + below, weight * u * v, x, channel, D, live)


@compiled
def _upstream(statistics, statistics_upstream, p, alive, NUMBER):
    """Statistics of some pixels (mean x, y, spread, peak), and gradients by x, y, peak, and by spread over
    it."""
    mean_x = tl.load(statistics + 4 * p, mask=alive, other=0)
    mean_y = tl.load(statistics + 4 * p + 1, mask=alive, other=0)
    spread = tl.load(statistics + 4 * p + 2, mask=alive, other=0)
    peak = tl.load(statistics + 4 * p + 3, mask=alive, other=0)
    gx = tl.load(statistics_upstream + 4 * p, mask=alive, other=0)
    gy = tl.load(statistics_upstream + 4 * p + 1, mask=alive, other=0)
    pull = tl.load(statistics_upstream + 4 * p + 2, mask=alive, other=0)
    pull = tl.where(spread > 0, pull / tl.where(spread > 0, spread, 1.0), 0.0).to(NUMBER)
    gpeak = tl.load(statistics_upstream + 4 * p + 3, mask=alive, other=0)
    return mean_x, mean_y, spread, peak, gx, gy, gpeak, pull


@compiled
def _backward(
    query,
    key,
    value,
    points,
    mask,
    fractions,
    bias,
    pixels,
    alpha_pixels,
    height,
    width,
    samples,
    statistics,
    logsum,
    best,
    out,
    upstream,
    statistics_upstream,
    query_out,
    key_out,
    value_out,
    points_out,
    bias_out,
    D: tl.constexpr,
    DV: tl.constexpr,
    D_BLOCK: tl.constexpr,
    DV_BLOCK: tl.constexpr,
    PIXELS: tl.constexpr,
    SHARED: tl.constexpr,
    STRAIGHT: tl.constexpr,
    NEAREST: tl.constexpr,
    BIASED: tl.constexpr,
    NUMBER: tl.constexpr,
    WANTS_BIAS: tl.constexpr,
):
    p, alive, place, first = _places(pixels, alpha_pixels, height, width, PIXELS, SHARED)
    c, cv = tl.arange(0, D_BLOCK), tl.arange(0, DV_BLOCK)
    q = _rows(query, p, c, D, alive[:, None] & (c < D)[None, :], NUMBER)
    g = _rows(upstream, p, cv, DV, alive[:, None] & (cv < DV)[None, :], NUMBER)
    lse = tl.load(logsum + p, mask=alive, other=float("-inf"))
    alive = alive & (lse > float("-inf"))
    lse = tl.where(alive, lse, 0.0)
    at_best = tl.load(best + p, mask=alive, other=0)
    mean = tl.sum(g * _rows(out, p, cv, DV, alive[:, None] & (cv < DV)[None, :], NUMBER), 1)
    mean_x, mean_y, spread, peak, gx, gy, gpeak, pull = _upstream(
        statistics, statistics_upstream, p, alive, NUMBER
    )
    by_query = tl.zeros([PIXELS, D_BLOCK], NUMBER)
    x_start, y_start = tl.zeros([PIXELS], NUMBER), tl.zeros([PIXELS], NUMBER)
    x_end, y_end = tl.zeros([PIXELS], NUMBER), tl.zeros([PIXELS], NUMBER)
    for i in range(samples):
        x, y, counts = _sample(points, mask, fractions, place, alive, height, width, i, samples, STRAIGHT)
        pixel, across, below, u, v = _cell(x, y, height, width, NEAREST)
        pixel += first
        live, live_v = counts[:, None] & (c < D)[None, :], counts[:, None] & (cv < DV)[None, :]
        s0, s1, s2, s3 = _dots(q, key, pixel, across, below, c, D, live, NEAREST, NUMBER)
        score = _blend(s0, s1, s2, s3, u, v)
        if BIASED:
            score += tl.load(bias + p * samples + i, mask=alive, other=0)
        w = tl.where(counts, tl.exp(tl.where(counts, score - lse, 0.0)), 0.0)
        v0, v1, v2, v3 = _dots(g, value, pixel, across, below, cv, DV, live_v, NEAREST, NUMBER)
        # The gradient by the sample's weight, less its mean over weights.
        dx, dy = x - mean_x, y - mean_y
        slope = _blend(v0, v1, v2, v3, u, v) - mean + gx * dx + gy * dy
        slope = slope + 0.5 * pull * (dx * dx + dy * dy - spread * spread)
        by_score = w * (slope + gpeak * (tl.where(at_best == i, 1.0, 0.0) - peak))
        by_query += by_score[:, None] * _blended(key, pixel, across, below, u, v, c, D, live, NEAREST, NUMBER)
        _add_around(key_out, pixel, across, below, u, v, by_score, q, c, D, live, NEAREST)
        _add_around(value_out, pixel, across, below, u, v, w, g, cv, DV, live_v, NEAREST)
        dx, dy = w * (gx + pull * (x - mean_x)), w * (gy + pull * (y - mean_y))
        if not NEAREST:
            across_s = (1 - v) * (s1 - s0) + v * (s3 - s2)
            across_v = (1 - v) * (v1 - v0) + v * (v3 - v2)
            below_s = (1 - u) * (s2 - s0) + u * (s3 - s1)
            below_v = (1 - u) * (v2 - v0) + u * (v3 - v1)
            dx += tl.where((x >= 0) & (x <= width - 1), by_score * across_s + w * across_v, 0.0)
            dy += tl.where((y >= 0) & (y <= height - 1), by_score * below_s + w * below_v, 0.0)
        if WANTS_BIAS:
            tl.store(bias_out + p * samples + i, by_score, mask=counts)
        if STRAIGHT:
            f = tl.load(fractions + i)
            x_start, y_start = x_start + (1 - f) * dx, y_start + (1 - f) * dy
            x_end, y_end = x_end + f * dx, y_end + f * dy
        else:
            tl.store(points_out + 2 * (p * samples + i), dx, mask=counts)
            tl.store(points_out + 2 * (p * samples + i) + 1, dy, mask=counts)
    if STRAIGHT:
        tl.store(points_out + 4 * p, x_start, mask=alive)
        tl.store(points_out + 4 * p + 1, y_start, mask=alive)
        tl.store(points_out + 4 * p + 2, x_end, mask=alive)
        tl.store(points_out + 4 * p + 3, y_end, mask=alive)
    live = (p < pixels)[:, None] & (c < D)[None, :]
    tl.store(query_out + p[:, None] * D + c[None, :], by_query.to(query_out.dtype.element_ty), mask=live)
