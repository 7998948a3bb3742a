"""The fusion's own photometric error, as a function of the rig.

C3 attention looks along each alpha pixel's segment in beta for what is like it, and returns what it finds there: the
error is by how much that misses alpha's own value. Attention finds the place along the segment; across it, only the
rig can. Bilinear sampling lets the error's gradient reach the segments' ends and with them the rig.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from kornia.color import rgb_to_grayscale
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad, unfold

from arraygeom import (
    Pair,
    Positions,
    Rig,
    Segments,
    pixel_grid,
)
from arraygeom.fields import recorded_field

from .matches import ENOUGH, Matches, seen_depths


@runtime_checkable
class Attended(Protocol):
    """What attention returns: values (1, D, h, w) and how sure it is of one place (1, h, w)."""

    @property
    def value(self) -> Tensor:
        """What was found."""
        ...

    @property
    def peak(self) -> Tensor:
        """The largest weight."""
        ...


Attend = Callable[[Tensor, Tensor, Tensor, Segments | Positions], Attended]
"""Attention from queries to keys and values along a field: `pat.attention.attend_with_statistics`."""
Describe = Callable[[Tensor], Tensor]
"""A grey image (1, 1, H, W) to features (1, D, H, W) whose inner product says how alike two pixels are."""

LARGEST = 480
"""Images are reduced to this many pixels along their longer side."""
PIXELS = 6000
"""Alpha pixels that are looked at, about, on a grid."""
SHARPNESS = 20.0
"""The inner product of two equal descriptors."""
WINDOW = 9
"""Values are relative to the mean and the deviation in windows this wide, so that exposure and filters do not count."""
EVEN = 0.02
"""Deviations below this, of images in 0..1, are noise."""


@dataclass(frozen=True)
class Views:
    """One frame made ready, by camera: the reduced size, features (1, D, H, W) and values (1, 1, H, W) of each pixel,
    and the grid (h, w, 2) of pixels that are looked at from there."""

    hw: Mapping[str, tuple[int, int]]
    keys: Mapping[str, Tensor]
    values: Mapping[str, Tensor]
    grid: Mapping[str, Tensor]

    @classmethod
    def of(cls, images: Mapping[str, Float[Tensor, "_ _ _"]], describe: Describe | None = None) -> Views:
        """The frame's images reduced and described; by patches, unless by something better."""
        grey = {name: _reduced(image) for name, image in images.items()}
        keys = {name: (describe or patches)(image) for name, image in grey.items()}
        sizes = {name: (int(p.shape[2]), int(p.shape[3])) for name, p in grey.items()}
        grid = {name: _grid(hw) for name, hw in sizes.items()}
        return cls(sizes, keys, {name: structure(image) for name, image in grey.items()}, grid)


def photometric_errors(
    rig: Rig, views: Views, names: tuple[str, str], attend: Attend
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """By how much what attention finds in beta misses alpha, at the pixels of the grid, and where it looked at all.

    Differentiable in the rig. Pixels count by how sure attention is of one place: errors are weighted by its peak.
    """
    alpha, beta = names
    for name in names:
        rig = rig.resize(name, views.hw[name])
    pair, x = rig.pair(*names).to(torch.float32), views.grid[alpha]
    look = recorded_field(pair, samples=64, nodes=16)(pair, x)
    columns, rows = x[0, :, 0].long(), x[:, 0, 1].long()
    query, own = (image[alpha][:, :, rows][..., columns] for image in (views.keys, views.values))
    found = attend(query, views.keys[beta], views.values[beta], look)
    seen = look.mask.any(-1) if isinstance(look, Positions) else look.valid
    sure = found.peak[0].detach().sqrt()
    return torch.where(seen, sure * (found.value - own)[0, 0], 0.0), seen


def with_depths(rig: Rig, pairs: Mapping[tuple[str, str], Matches]) -> Rig:
    """The rig with the depth range of what is matched, if it has none."""
    if rig.depth is not None:
        return rig
    bounds = [_bounds(rig.pair(*names), matches) for names, matches in pairs.items()]
    known = [b for b in bounds if b is not None]
    return rig.replace(depth=(min(n for n, _ in known), max(f for _, f in known))) if known else rig


def _bounds(pair: Pair, matches: Matches) -> tuple[float, float] | None:
    if not pair.calibrated or len(matches.alpha) < ENOUGH:
        return None
    try:
        return seen_depths(pair, matches)
    except ValueError:
        return None


def patches(grey: Float[Tensor, "1 1 h w"]) -> Float[Tensor, "1 25 h w"]:
    """5 x 5 pixels around each, without their mean, of one length: the inner product is their correlation, scaled."""
    h, w = grey.shape[-2:]
    around = unfold(pad(grey, (2, 2, 2, 2), mode="replicate"), 5).view(1, 25, h, w)
    around = around - around.mean(1, keepdim=True)
    length = around.square().sum(1, keepdim=True).add(25 * EVEN**2).sqrt()
    return around / length * SHARPNESS**0.5


def structure(grey: Float[Tensor, "1 1 h w"]) -> Float[Tensor, "1 1 h w"]:
    """How far each pixel is from the mean around it, in deviations."""
    mean, square = (_local_mean(p) for p in (grey, grey.square()))
    return (grey - mean) / (square - mean.square()).clamp(min=0).add(EVEN**2).sqrt()


def _local_mean(grey: Tensor) -> Tensor:
    r = WINDOW // 2
    return avg_pool2d(pad(grey, (r, r, r, r), mode="replicate"), WINDOW, 1)


def _reduced(image: Tensor) -> Tensor:
    grey = (rgb_to_grayscale(image) if image.shape[0] == 3 else image)[None].float()
    h, w = grey.shape[-2:]
    factor = LARGEST / max(h, w)
    if factor >= 1:
        return grey
    return interpolate(grey, size=(round(h * factor), round(w * factor)), mode="bilinear", antialias=True)


def _grid(hw: tuple[int, int]) -> Tensor:
    step = max(1, round((hw[0] * hw[1] / PIXELS) ** 0.5))
    return pixel_grid(hw)[step // 2 :: step, step // 2 :: step]
