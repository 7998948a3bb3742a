"""Search segments and sampling positions in beta, the interface of geometry and attention.

`Segments` is the compact form, two points for each alpha pixel; `Positions` is the explicit one. Both hold
(x, y) in beta's pixels, the centre of the first pixel being (0, 0). An image of height H and width W covers
the area [-0.5, W - 0.5] x [-0.5, H - 0.5]: positions on it can be sampled, all others cannot.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .batching import Batched
from .pixels import HW, pixel_grid, safe_sqrt
from .runtime.text import share_text
from .runtime.tracing import followed


@dataclass(frozen=True, eq=False, repr=False)
class Positions(Batched):
    """Explicit sample positions, L for each alpha pixel; nothing is checked.

    Attributes:
        xy: positions, pixels of beta; without meaning where `mask` is False.
        mask: True for samples that count; without any, beta does not see the alpha pixel.
    """

    item_axes: ClassVar = {"xy": 2, "mask": 1}
    xy: Float[Tensor, "*n l 2"]
    mask: Bool[Tensor, "*n l"]

    def _text(self) -> str:
        return f"{self.mask.shape[-1]} samples each, {share_text(self.mask)} valid"


@dataclass(frozen=True, eq=False, repr=False)
class Segments(Batched):
    """One straight piece of beta's image for each alpha pixel; nothing is checked.

    For a depth-bounded field `start` is the point at the near bound and `end` at the far bound.

    Attributes:
        start: first end, pixels of beta.
        end: second end.
        valid: False where there is nothing to sample; the ends are then finite and mean nothing.
    """

    item_axes: ClassVar = {"start": 1, "end": 1}
    start: Float[Tensor, "*n 2"]
    end: Float[Tensor, "*n 2"]
    valid: Bool[Tensor, "*n"]

    @property
    def length(self) -> Float[Tensor, "*n"]:
        """Length in pixels. Differentiable, also at zero length (where the gradient is zero)."""
        x, y = (self.end - self.start).unbind(-1)  # a sum over an axis of two takes four times as long
        squared = x * x + y * y
        if not (squared.requires_grad or followed()):
            return squared.sqrt_()
        return safe_sqrt(squared)

    def at(self, fraction: Float[Tensor, "*n"]) -> Float[Tensor, "*n 2"]:
        """Return the point at a fraction of the way from start (0) to end (1)."""
        return self.start + fraction[..., None] * (self.end - self.start)

    def fraction(self, xy: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n"]:
        """Return the fraction of the line's point nearest to `xy`, not clamped to 0..1; 0.5 if no length."""
        along = self.end - self.start
        squared = along.square().sum(-1)
        positive = squared > 0
        inner = ((xy - self.start) * along).sum(-1)
        return torch.where(positive, inner / torch.where(positive, squared, 1.0), 0.5)

    def positions(self, samples: int) -> Positions:
        """Return `samples` evenly spaced positions, the first at start, the last at end (one sample: the
        middle); all of a segment count, or none if it is not valid.

        >>> s = Segments(torch.tensor([0.0, 4.0]), torch.tensor([6.0, 4.0]), torch.tensor(True))
        >>> s.positions(3).xy[:, 0].tolist()
        [0.0, 3.0, 6.0]

        Raises:
            ValueError: for fewer than 1 sample.
        """
        u = sample_fractions(samples, like=self.start)
        xy = self.start[..., None, :] + u[:, None] * (self.end - self.start)[..., None, :]
        return Positions(xy, self.valid[..., None].expand(xy.shape[:-1]))

    def distance(self, xy: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n"]:
        """Compute the distance in pixels from points to their segments; infinite where not valid."""
        u = self.fraction(xy).clamp(0, 1)
        distance = safe_sqrt((xy - self.at(u)).square().sum(-1))
        return torch.where(self.valid, distance, torch.inf)

    def mask(self, hw: HW, radius: float = 0.5) -> Bool[Tensor, "*n p"]:
        """Mark beta's pixels within `radius` pixels of each segment.

        The result is an `attn_mask` of `scaled_dot_product_attention` for alpha's pixels (n) as queries and
        beta's as keys: n H W flags, so for small images; `pat.attention.segment_block_mask` is for large
        ones.

        Returns:
            Mask (*n, H W), beta's pixels row by row; all False for an invalid segment.
        """
        axes = (*self.valid.shape, hw[0] * hw[1])
        xy = pixel_grid(hw, dtype=self.start.dtype, device=self.start.device).reshape(-1, 2).expand(*axes, 2)
        start, end = (v[..., None, :].expand(*axes, 2) for v in (self.start, self.end))
        return Segments(start, end, self.valid[..., None].expand(axes)).distance(xy) <= radius

    def _text(self) -> str:
        length = self.length[self.valid]
        median = f", median length {float(length.detach().median()):.1f} px" if length.numel() else ""
        return f"{share_text(self.valid)} valid{median}"


def clip_to_image(start: Float[Tensor, "*n 2"], end: Float[Tensor, "*n 2"], hw: HW) -> Segments:
    """Clip each segment, from `start` to `end` in pixels, to the area of an image of size `hw` (Liang and
    Barsky 1984).

    Returns:
        Segments, from `start`'s side to `end`'s; zero and invalid where nothing is left, and for NaN.
    """
    low, high = fractions_on_image(start, end, hw)
    valid = low <= high
    first, last = (_on_image(start, end, s, valid, hw) for s in (low, high))
    return Segments(first, last, valid)


def fractions_on_image(
    start: Float[Tensor, "*n 2"], end: Float[Tensor, "*n 2"], hw: HW
) -> tuple[Float[Tensor, "*n"], Float[Tensor, "*n"]]:
    """Compute the fractions (0 start, 1 end) between which each segment is on the image.

    Returns:
        (low, high), low > high where it is nowhere; NaN for NaN.
    """
    low, high = torch.zeros_like(start[..., 0]), torch.ones_like(start[..., 0])
    for a, b, limit in zip(start.unbind(-1), end.unbind(-1), (hw[1] - 0.5, hw[0] - 0.5)):
        moves = b - a
        flat = moves.abs() < FLAT
        slowness = 1 / torch.where(flat, 1.0, moves)
        first, last = (-0.5 - a) * slowness, (limit - a) * slowness
        inside = (a >= -0.5) & (a <= limit)
        low = torch.maximum(low, torch.where(flat, torch.where(inside, 0.0, 2.0), torch.minimum(first, last)))
        high = torch.minimum(high, torch.where(flat, 1.0, torch.maximum(first, last)))
    return low, high


def _on_image(start: Tensor, end: Tensor, s: Tensor, valid: Tensor, hw: HW) -> Tensor:
    """Points at fraction s, kept inside the image despite rounding; zero where not valid."""
    s = torch.where(valid, s, 0.0)
    limits = zip(start.unbind(-1), end.unbind(-1), (hw[1] - 0.5, hw[0] - 0.5))
    return torch.stack([torch.where(valid, (a + s * (b - a)).clamp(-0.5, m), 0.0) for a, b, m in limits], -1)


FLAT = 1e-6
"""Pixels that an image limit moves by along a whole segment, below which it is either inside or not."""


def sample_fractions(samples: int, *, like: Tensor) -> Float[Tensor, " l"]:
    """Return the positions of a segment's samples as fractions: l / (L - 1) for l = 0 .. L - 1; 0.5 for a
    single one. They have the type and device of `like`.

    Raises:
        ValueError: for fewer than 1 sample.
    """
    if samples < 1:
        raise ValueError(f"samples must be at least 1, got {samples}")
    if samples == 1:
        return like.new_full((1,), 0.5)
    return torch.linspace(0, 1, samples, dtype=like.dtype, device=like.device)
