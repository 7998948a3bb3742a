"""More range than one camera has: alpha's brightness merged with that of betas exposed otherwise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from arraygeom import Camera, Rig, pixel_grid, sample

from .develop import light_of, to_linear
from .fuse import FusedFrame
from .sensors import Coded

WHITE = 0.97
"""Values from here on count as cut off."""
READ_NOISE = 1.5e-3
"""Variance of reading over that of one white of light, for weighing exposures: typical of machine vision sensors."""


def merged(frame: FusedFrame, rig: Rig, images: Mapping[str, Float[Tensor, "_ _ _"]], alpha: str) -> FusedFrame:
    """The fused frame with brightness from all cameras, coded as sRGB, above 1 where alpha's white is exceeded.

    Betas, one band each, are looked up by the frame's depth. What alpha would read is a sum of the bands, fitted where
    no camera is at its limits; it is averaged with alpha's own reading by the noise that each has, and takes its
    place where alpha is at white. `rig` says the exposures and gains. Raises ValueError if nothing can be fitted.
    """
    own = to_linear(images[alpha])[0]
    names = [name for name in rig.betas(alpha) if name in images and images[name].shape[0] == 1]
    bands = torch.stack([_at_alpha(frame, rig, images[name], alpha, name) for name in names])
    scale = [light_of(rig[name].sensor, rig[alpha].sensor) for name in names]
    good = torch.stack([(b.isfinite()) & (b * s < WHITE) for b, s in zip(bands, scale)]).all(0)
    weights = _fit(bands[:, good & (own < WHITE) & (own > 0.05)], own[good & (own < WHITE) & (own > 0.05)])
    bands = torch.where(good, bands, 0.0)
    theirs = (weights[:, None, None] * bands).sum(0).clamp(min=0)
    noise = sum((w / s) ** 2 * (b * s + READ_NOISE) for w, s, b in zip(weights, scale, bands))
    believed = torch.where(good, frame.confidence / noise, 0.0)
    known = torch.where(own < WHITE, 1 / (own + READ_NOISE), 0.0)
    total = believed + known
    light = torch.where(total > 0, (believed * theirs + known * own) / total.clamp(min=1e-12), own)
    light = torch.where((own >= WHITE) & good, torch.maximum(theirs, own), light)
    colours = to_linear(frame.image.clamp(min=0)) * (light / own.clamp(min=1e-5))
    return frame._replace(image=Coded().apply(colours[None], Generator())[0])


def _at_alpha(frame: FusedFrame, rig: Rig, image: Tensor, alpha: str, name: str) -> Float[Tensor, "h w"]:
    """Linear light of a beta at alpha's pixels, by depth; NaN where it is not known or not on the picture."""
    a, b = rig[alpha], rig[name]
    if not (isinstance(a, Camera) and isinstance(b, Camera)):
        raise ValueError("merging exposures needs calibrated cameras: the depth tells where betas see a point")
    X = a.to(torch.float32).unproject(pixel_grid(a.hw), frame.depth)
    x, _, valid = b.to(torch.float32).project(X)
    found = sample(to_linear(image)[None], torch.where(valid[..., None], x, -1e3)[None])
    return torch.where(valid & found.valid[0], found.values[0, 0], torch.nan)


def _fit(bands: Float[Tensor, "m n"], own: Float[Tensor, " n"]) -> Float[Tensor, " m"]:
    if len(own) < 100:
        raise ValueError("exposures cannot be merged: hardly a point is within the range of all cameras")
    relative = 1 / (own + 0.02)
    return torch.linalg.lstsq((bands * relative).T, (own * relative)[:, None]).solution[:, 0]


class Usable(NamedTuple):
    """The darkest and the brightest light that a picture tells, and their ratio in factors of two."""

    low: float
    high: float

    @property
    def stops(self) -> float:
        """log2(high / low)."""
        return float(torch.tensor(self.high / self.low).log2())


def usable_range(
    told: Sequence[Float[Tensor, "*n"]], truth: Sequence[Float[Tensor, "*n"]], *, within: float = 0.25
) -> Usable:
    """The widest run of half-stops of true light in which a picture's relative error (median) is `within` this.

    Raises ValueError if there is none.
    """
    t, light = (torch.cat([v.flatten() for v in values]) for values in (told, truth))
    bins = (2 * light.clamp(min=1e-7).log2()).floor().long()
    runs: list[list[int]] = [[]]
    for i in range(int(bins.min()), int(bins.max()) + 1):
        here = bins == i
        if here.sum() < 50:
            continue
        right = float(((t[here] - light[here]).abs() / light[here]).median()) <= within
        runs = [*runs[:-1], [*runs[-1], i]] if right else [*runs, []]
    best = max(runs, key=len)
    if not best:
        raise ValueError("the picture tells no light anywhere")
    return Usable(2 ** (best[0] / 2), 2 ** ((best[-1] + 1) / 2))
