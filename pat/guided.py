"""GuidedPAT: C3 attention from coarse to fine, colour guided by alpha.

Our own network, for one alpha whose detail is to be kept and betas that know the colours. It matches
luminance-like features at a quarter of the size with wide context, corrects the match and judges whether beta
sees the point at all, looks again at full size in a short window around it, carries colour from pixels that are
certain to those that are not, and adds it to alpha.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, pixel_shuffle, pixel_unshuffle

from arraygeom import Local, Pair, Segments, View, lazily, pixel_grid

from .attention import Attended, attend, attend_with_statistics
from .blocks import ResidualBlock, conv, enlarge
from .images import luminance
from .model import Fused, Look, Looks

COARSE = 4
"""The first look is at pictures of a quarter of the size."""
UNSURE = 1e-3
"""The certainty that every pixel has at least."""
NOWHERE = -10.0
"""The logit of the confidence where there is nowhere to look."""


@dataclass(frozen=True)
class GuidedPATConfig:
    """Widths of the features at 1/2, 1/4, 1/8 and 1/16 of the size, and of the keys.

    The second look reaches `window` pixels to either side of the first's answer, with `taps` samples.
    Colour is carried within alpha in one round for each of `carry_steps`, the spacing of 7 x 7 pixels at 1/4.
    `keep_luminance` lets the network add colour to alpha, and never luminance.
    """

    widths: tuple[int, int, int, int] = (16, 32, 40, 48)
    coarse_dim: int = 32
    coarse_value: int = 16
    fine_dim: int = 8
    window: float = 4.0
    taps: int = 17
    carry_dim: int = 8
    carry_steps: tuple[int, ...] = (1, 3, 8)
    bands: int = 3
    keep_luminance: bool = True


class Match(NamedTuple):
    """The first look, corrected, at a quarter of the size.

    reach: (B, 1, h, w), how far from the segment's end (the far bound) the match is, pixels of beta.
    position: (B, 2, h, w), the match in beta's pixels.
    logit: (B, 1, h, w), of the confidence that beta sees the point there.
    """

    reach: Tensor
    position: Tensor
    logit: Tensor


class Encoded(NamedTuple):
    """Features at 1/2 of the size, and at 1/4 with context."""

    half: Tensor
    quarter: Tensor


class GuidedPAT(nn.Module):
    """Any number of betas whose bands, in order, are the output's: one RGB camera, or three with filters.

    Betas are to be of about alpha's angular resolution (enlarge or reduce them with the rig), and all sizes
    multiples of 16.
    """

    multiple = 16
    equal_pitch = True
    halo = 608
    """Encoder 85, judge 176, carrying 148, propagation 180 and head 12: the sum, rounded up."""
    beta_halo = 96
    bytes_per_pixel = 320.0

    def __init__(self, config: GuidedPATConfig = GuidedPATConfig()) -> None:
        super().__init__()
        self.config = c = config
        w2, w4, _, _ = c.widths
        self.encoder = Encoder(c.widths)
        self.coarse_key = nn.Conv2d(w4, c.coarse_dim, 1)
        self.coarse_value = nn.Conv2d(w4, c.coarse_value, 1)
        self.judge = UNet(w4 + c.coarse_value + 4, c.widths[1:], 2)
        self.fine_key = nn.Conv2d(w2, 4 * c.fine_dim, 1)
        self.propagate = UNet(w4 + 2 * c.bands, c.widths[1:], c.widths[0])
        self.carry = nn.ModuleList(Carry(w4, c.carry_dim, step) for step in c.carry_steps)
        self.head = Head(w2, c.bands)

    def forward(
        self, alpha: Float[Tensor, "b 1 h w"], betas: Sequence[Float[Tensor, "b _ _ _"]], looks: Looks
    ) -> Fused:
        """Fuse alpha (B, 1, H, W) with the betas. The image has the betas' bands.

        Raises ValueError if those do not add up to the configured number.
        """
        return self.explain(alpha, betas, looks)[0]

    def explain(
        self, alpha: Float[Tensor, "b 1 h w"], betas: Sequence[Float[Tensor, "b _ _ _"]], looks: Looks
    ) -> tuple[Fused, list[Match]]:
        """The same, with the first look's matches, which training supervises."""
        bands = sum(b.shape[1] for b in betas)
        if bands != self.config.bands:
            raise ValueError(f"the betas have {bands} bands in all, this network makes {self.config.bands}")
        own = self.encoder(alpha)
        seen = [self._see(own, beta, look) for beta, look in zip(betas, looks)]
        attended, matches = zip(*seen)
        colours = [a.value.to(alpha) - alpha for a in attended]
        logits = [enlarge(m.logit, COARSE) for m in matches]
        carried = torch.cat([self._carried(own, c, z.sigmoid()) for c, z in zip(colours, logits)], 1)
        certain = torch.cat([z.sigmoid().expand_as(c) for z, c in zip(logits, colours)], 1)
        colour = torch.cat(colours, 1)
        rough = avg_pool2d(torch.cat([colour * certain, certain], 1), COARSE)
        context = self.propagate(torch.cat([own.quarter, rough], 1))
        colour = torch.lerp(enlarge(carried, COARSE), colour, certain)
        residual = colour + self.head(alpha, own.half, context, colour, certain)
        if self.config.keep_luminance:
            residual = residual - luminance(residual)
        fused = Fused(
            alpha + residual,
            [a.position for a in attended],
            [a.spread for a in attended],
            [z[:, 0].sigmoid() * (a.peak > 0) for z, a in zip(logits, attended)],
        )
        return fused, list(matches)

    def _carried(self, own: Encoded, colour: Tensor, certain: Tensor) -> Tensor:
        """Colour at 1/4 of the size, carried from certain pixels to others that look alike in alpha."""
        known = avg_pool2d(certain, COARSE)
        colour = avg_pool2d(colour * certain, COARSE) / (known + UNSURE)
        for carry in self.carry:
            colour, known = carry(own.quarter, colour, known)
        return colour

    def _see(self, own: Encoded, beta: Tensor, look: Look) -> tuple[Attended, Match]:
        guide = luminance(beta) if beta.shape[1] == 3 else beta.mean(1, keepdim=True)
        other = self.encoder(guide)
        hw = own.half.shape[-2] * 2, own.half.shape[-1] * 2
        match = self._first_look(own, other, look, hw)
        window = window_around(match.reach, _segments(look, hw, 1, self._exact(own.half)), self.config.window)
        query, key = (self._exact(pixel_shuffle(self.fine_key(f.half), 2)) for f in (own, other))
        return attend_with_statistics(query, key, self._exact(beta), window, samples=self.config.taps), match

    def _exact(self, x: Tensor) -> Tensor:
        """Float64 in use: rounded in float32, positions far to the right would differ from those of a tile there."""
        return x if self.training else x.double()

    def _first_look(self, own: Encoded, other: Encoded, look: Look, hw: tuple[int, int]) -> Match:
        query, key = (self._exact(self.coarse_key(f.quarter)) for f in (own, other))
        value = self._exact(self.coarse_value(other.quarter))
        segments = _segments(look, hw, COARSE, query)
        length = segments.length[:, None]
        valid = segments.valid[:, None]
        reduced = Segments(_reduced(segments.start), _reduced(segments.end), segments.valid)
        samples = -(-(look.samples - 1) // COARSE) + 1
        attended = attend_with_statistics(query, key, value, reduced, samples=samples)
        fraction = reduced.fraction(attended.position.movedim(1, -1))
        reach = torch.where(valid & (attended.peak[:, None] > 0), (1 - fraction)[:, None] * length, 0.0)
        facts = [reach / 64, attended.spread[:, None] / 4, attended.peak[:, None], valid.to(reach).expand_as(reach)]
        answer = self.judge(torch.cat([own.quarter, *(f.to(own.quarter) for f in (attended.value, *facts))], 1))
        reach = reach + COARSE * answer[:, :1]
        position = segments.end + reach[:, 0, :, :, None] * _along(segments)
        return Match(reach, position.movedim(-1, 1), torch.where(valid, answer[:, 1:], NOWHERE))


class Carry(nn.Module):
    """C3 attention of alpha to itself: each pixel takes colour from 7 x 7 around it that are certain and look alike.

    The logarithm of the certainty is added to the scores as one more channel of the keys. Without training all
    look alike, and this is a normalised convolution.
    """

    def __init__(self, width: int, dim: int, step: int) -> None:
        super().__init__()
        self.field = Local(7, spacing=step)
        self.query, self.key = nn.Conv2d(width, dim, 1), nn.Conv2d(width, dim, 1)
        nn.init.zeros_(self.query.weight)

    def forward(
        self, features: Float[Tensor, "b d h w"], colour: Float[Tensor, "b c h w"], sure: Float[Tensor, "b 1 h w"]
    ) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b 1 h w"]]:
        """Colour and certainty after one round."""
        view = View(hw=(features.shape[-2], features.shape[-1]))
        query = torch.cat([self.query(features), torch.ones_like(sure)], 1)
        key = torch.cat([self.key(features), (sure + UNSURE).log()], 1)
        look = lazily(self.field, Pair(view, view))
        found = attend(query, key, torch.cat([colour, sure], 1), look, interpolation="nearest")
        return found[:, :-1], found[:, -1:]


def window_around(reach: Float[Tensor, "b 1 h w"], segments: Segments, window: float) -> Segments:
    """Pieces of segments (B or 1, 4 h, 4 w), `window` pixels to either side of the match at `reach` from their end."""
    length = segments.length
    reach = enlarge(reach, COARSE)[:, 0].clamp(min=0).minimum(length)
    along = _along(segments)
    middle = segments.end + reach[..., None] * along
    return Segments(middle + window * along, middle - window * along, segments.valid.expand(reach.shape))


def _segments(look: Look, hw: tuple[int, int], step: int, like: Tensor) -> Segments:
    """The segments of every `step`-th block of alpha pixels, at its centre: (B or 1, h / step, w / step)."""
    grid = (hw[0] // step, hw[1] // step)
    x = (pixel_grid(grid, dtype=like.dtype, device=like.device) + 0.5) * step - 0.5
    found = look.at(x.reshape(-1, 2))
    if not isinstance(found, Segments):
        raise ValueError("GuidedPAT looks along straight segments: choose a straight field, or undistort the pictures")
    start, end = (v.reshape(-1, *grid, 2) for v in (found.start, found.end))
    return Segments(start, end, found.valid.reshape(-1, *grid))


def _along(segments: Segments) -> Tensor:
    """Unit vectors from end to start; zero where a segment is a point."""
    length = segments.length
    return (segments.start - segments.end) / torch.where(length > 0, length, 1.0)[..., None]


def _reduced(x: Tensor) -> Tensor:
    return (x + 0.5) / COARSE - 0.5


class Encoder(nn.Module):
    """Features of one grey picture, the same weights for every view."""

    def __init__(self, widths: tuple[int, int, int, int]) -> None:
        super().__init__()
        w2, w4, w8, _ = widths
        self.at_half = nn.Sequential(conv(4, w2), ResidualBlock(w2))
        self.at_quarter = nn.Sequential(conv(w2, w4, stride=2), ResidualBlock(w4))
        self.at_eighth = nn.Sequential(conv(w4, w8, stride=2), ResidualBlock(w8), ResidualBlock(w8, dilation=3))
        self.up = nn.Conv2d(w8, w4, 1)
        self.merge = ResidualBlock(w4)

    def forward(self, picture: Float[Tensor, "b 1 h w"]) -> Encoded:
        """Features of a picture whose sides are multiples of 8."""
        half = self.at_half(pixel_unshuffle(picture - 0.5, 2))
        quarter = self.at_quarter(half)
        return Encoded(half, self.merge(quarter + enlarge(self.up(self.at_eighth(quarter)))))


class UNet(nn.Module):
    """Three scales down and up again, residual blocks at each."""

    def __init__(self, inputs: int, widths: tuple[int, ...], outputs: int) -> None:
        super().__init__()
        a, b, c = widths
        self.first = nn.Sequential(conv(inputs, a), ResidualBlock(a))
        self.second = nn.Sequential(conv(a, b, stride=2), ResidualBlock(b))
        self.third = nn.Sequential(conv(b, c, stride=2), ResidualBlock(c), ResidualBlock(c, dilation=2))
        self.up_b, self.up_a = nn.Conv2d(c, b, 1), nn.Conv2d(b, a, 1)
        self.back_b, self.back_a = ResidualBlock(b), ResidualBlock(a)
        self.last = nn.Conv2d(a, outputs, 3, padding=1)

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o h w"]:
        """The same size; sides are multiples of 4."""
        first = self.first(x)
        second = self.second(first)
        second = self.back_b(second + enlarge(self.up_b(self.third(second))))
        return self.last(self.back_a(first + enlarge(self.up_a(second))))


class Head(nn.Module):
    """What to add to alpha, at full size, worked out on blocks of 2x2 pixels."""

    def __init__(self, width: int, bands: int) -> None:
        super().__init__()
        self.start = nn.Sequential(conv(4 * (1 + 2 * bands) + 2 * width, 24), ResidualBlock(24), ResidualBlock(24))
        self.last = nn.Conv2d(24, 4 * bands, 3, padding=1)
        nn.init.zeros_(self.last.weight)

    def forward(self, alpha: Tensor, half: Tensor, context: Tensor, colour: Tensor, certain: Tensor) -> Tensor:
        """(B, bands, H, W), from alpha, its features, the context at 1/4, colour differences and their certainty."""
        fine = pixel_unshuffle(torch.cat([alpha, colour, certain], 1), 2)
        return pixel_shuffle(self.last(self.start(torch.cat([fine, half, enlarge(context)], 1))), 2)
