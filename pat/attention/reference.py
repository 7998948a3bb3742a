"""C3 attention as a formula: plain torch, any device, differentiable any number of times. Slow; the fast
backends are tested against it.

For the alpha pixel x with the query q, and its samples x_1 .. x_L in beta that count,

    score_l  = q . K(x_l) + bias_l
    weight_l = exp(score_l) / sum_m exp(score_m)
    output   = sum_l weight_l V(x_l)

(the physics-aware transformer, eq. 3 to 5: no scale, no position code). Shapes are written on the lines with
b images, d channels, r rows of w alpha pixels, l samples. Alpha is processed in bands of rows, so that
without gradients no more than `BAND_BYTES` of gathered keys and values exist at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from arraygeom.runtime.chunks import chunked
from arraygeom.sampling import on_image
from arraygeom.segments import sample_fractions

BAND_BYTES = 2**27
LEAST_DEVIATION = 1e-4
"""Deviation in pixels below which it is set to 0: it is rounding, and its derivative noise."""


class SamplePositions(NamedTuple):
    """Sampling locations in one form; the batch axis p is 1 or b.

    Attributes:
        points: (p, ha, wa, n, 2), (x, y) in beta's pixels: the n samples, or for `straight` the start and
            end of a segment.
        mask: (p, ha, wa, n or 1), True for valid samples.
        samples: samples of each pixel.
        straight: True for segments.
    """

    points: Tensor
    mask: Tensor
    samples: int
    straight: bool

    def positions(self) -> Tensor:
        """Return all samples, (p, r, w, l, 2), in beta's pixels."""
        if not self.straight:
            return self.points
        start, end = self.points.unbind(-2)  # p r w 2
        u = sample_fractions(self.samples, like=start)
        return start[..., None, :] + u[:, None] * (end - start)[..., None, :]


class AttentionInputs(NamedTuple):
    """Inputs of the backends, which do not check them.

    Attributes:
        query: (b, d, ha, wa).
        key: (b, d, hb, wb), of the query's dtype and device, as is `value`.
        value: (b, dv, hb, wb).
        positions: positions of the samples.
        bias: (b, ha, wa, l), added to the scores, of any dtype; None for none.
        nearest: True for nearest look-up, False for bilinear.
    """

    query: Tensor
    key: Tensor
    value: Tensor
    positions: SamplePositions
    bias: Tensor | None
    nearest: bool


class Attended(NamedTuple):
    """Outputs of attention along the search segments (C3) for each alpha pixel; 0 where no sample counts.

    Attributes:
        value: (b, dv, ha, wa), weighted mean of the values.
        position: (b, 2, ha, wa), expected (x, y) of the match, beta's pixels.
        deviation: (b, ha, wa), root of the expected squared distance of the samples from `position`, pixels;
            0 below `LEAST_DEVIATION`.
        peak: (b, ha, wa), largest weight.
    """

    value: Tensor
    position: Tensor
    deviation: Tensor
    peak: Tensor


def attend(inputs: AttentionInputs) -> Attended:
    """Compute attention by its formula in plain torch, some rows of alpha at a time.

    Returns:
        Values in the query's type, and statistics in `accumulated` precision; differentiable any number of
        times.
    """
    query, positions, bias = inputs.query, inputs.positions, inputs.bias
    counted = accumulated(query)

    def band(query: Tensor, points: Tensor, mask: Tensor, *bias_rows: Tensor) -> Attended:
        here = positions._replace(points=points, mask=mask)
        biased = bias_rows[0].to(counted) if bias_rows else None
        return _band(AttentionInputs(query.to(counted), key, value, here, biased, inputs.nearest))

    with torch.autocast(query.device.type, enabled=False):
        key, value = (channels_last(plane.to(counted)) for plane in (inputs.key, inputs.value))
        biases = [] if bias is None else [bias]
        channels = key.shape[-1] + value.shape[-1]
        row_bytes = 2 * query[:, 0, 0].numel() * positions.samples * channels * key.element_size()
        rows = max(1, BAND_BYTES // max(1, row_bytes))
        tensors = query.permute(0, 2, 3, 1), positions.points, positions.mask, *biases
        out = Attended(*chunked(band, *tensors, rows=rows, axis=1))
    value = out.value.to(query.dtype).permute(0, 3, 1, 2)
    return Attended(value, out.position.permute(0, 3, 1, 2), out.deviation, out.peak)


def log_sum(inputs: AttentionInputs) -> Tensor:
    """Compute log sum_l exp(score_l) over samples that count, (b, r, w); 0 without any. Gathers all keys."""
    query = inputs.query.permute(0, 2, 3, 1)
    score, counts, _ = _scores(inputs._replace(query=query, key=channels_last(inputs.key)))
    some = counts.any(-1)
    return torch.where(some, torch.where(counts | ~some[..., None], score, -torch.inf).logsumexp(-1), 0)


def accumulated(tensor: Tensor) -> torch.dtype:
    """Return the type in which numbers of a tensor's type are summed: float64 for float64, else float32."""
    return torch.float64 if tensor.dtype == torch.float64 else torch.float32


def channels_last(image: Tensor) -> Tensor:
    """Permute (b, d, h, w) to a contiguous (b, h, w, d); a copy only if memory has another order."""
    return image.permute(0, 2, 3, 1).contiguous()


def _band(inputs: AttentionInputs) -> Attended:
    """Attention of a band; images are channels last: (b, r, w, d) and (b, h, w, d)."""
    score, counts, xy = _scores(inputs)
    weight = _softmax(score, counts)
    out = torch.einsum("brwl,brwld->brwd", weight, _look_up(inputs)(inputs.value, xy))
    return Attended(out, *_statistics(weight, xy))


def _scores(inputs: AttentionInputs) -> tuple[Tensor, Tensor, Tensor]:
    """Scores (b, r, w, l), mask of the samples that count, positions of these; channels last."""
    q, key, positions = inputs.query, inputs.key, inputs.positions
    b, r, w, _ = q.shape
    xy = positions.positions().to(q.dtype)  # p r w l 2
    counts = positions.mask & on_image(xy, (key.shape[1], key.shape[2]))  # p r w l
    xy = torch.where(counts[..., None], xy, 0).expand(b, r, w, positions.samples, 2)
    score = torch.einsum("brwd,brwld->brwl", q, _look_up(inputs)(key, xy))
    return score if inputs.bias is None else score + inputs.bias, counts, xy


def _look_up(inputs: AttentionInputs) -> Callable[[Tensor, Tensor], Tensor]:
    return _nearest if inputs.nearest else _bilinear


def _nearest(image: Tensor, xy: Tensor) -> Tensor:
    """Look-up of (b, h, w, d) at (b, ..., 2) in the pixel whose area contains the position: (b, ..., d)."""
    x, y = (xy.detach() + 0.5).floor().long().unbind(-1)
    h, w = image.shape[1:3]
    return _pick(image, x.clamp(0, w - 1), y.clamp(0, h - 1))


def _bilinear(image: Tensor, xy: Tensor) -> Tensor:
    """Bilinear look-up of (b, h, w, d) at (b, ..., 2): (b, ..., d); the border's value beyond its centres."""
    h, w = image.shape[1:3]
    x0, x1, u = _cell(xy[..., 0], w)
    y0, y1, v = _cell(xy[..., 1], h)
    upper = (1 - u) * _pick(image, x0, y0) + u * _pick(image, x1, y0)
    lower = (1 - u) * _pick(image, x0, y1) + u * _pick(image, x1, y1)
    return (1 - v) * upper + v * lower


def _cell(c: Tensor, n: int) -> tuple[Tensor, Tensor, Tensor]:
    """The two pixels around a coordinate on an axis of n pixels, and the fraction (..., 1) between them."""
    c = c.clamp(0, n - 1)
    lower = c.detach().floor().clamp(max=max(n - 2, 0))
    index = lower.long()
    return index, (index + 1).clamp(max=n - 1), (c - lower)[..., None]


def _pick(image: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Channels at integer pixels: (b, h, w, d) at (b, ...) gives (b, ..., d)."""
    b, h, w, d = image.shape
    first = (torch.arange(b, device=x.device) * (h * w)).view(b, *[1] * (x.dim() - 1))
    return image.reshape(b * h * w, d)[first + y * w + x]


def _softmax(score: Tensor, counts: Tensor) -> Tensor:
    """Softmax over the last axis, restricted to samples that count; all zeros without any, with zero
    gradients."""
    top = torch.where(counts, score.detach(), -torch.inf).amax(-1, keepdim=True)
    top = torch.where(top.isfinite(), top, 0)
    e = torch.where(counts, torch.where(counts, score - top, 0).exp(), 0)
    total = e.sum(-1, keepdim=True)
    return e / torch.where(total > 0, total, 1)


def _statistics(weight: Tensor, xy: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Position (b, r, w, 2), deviation (b, r, w) and peak (b, r, w) of weights (b, r, w, l)."""
    position = torch.einsum("brwl,brwlc->brwc", weight, xy)
    squared = (weight * (xy - position[..., None, :]).square().sum(-1)).sum(-1)
    positive = squared > LEAST_DEVIATION**2
    deviation = torch.where(positive, torch.where(positive, squared, 1).sqrt(), 0)
    return position, deviation, weight.max(-1).values
