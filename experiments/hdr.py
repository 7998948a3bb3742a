"""High dynamic range: alpha's brightness merged with that of betas of other exposures."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Rig, pixel_grid, sample
from pat.fusion.frame import Frame
from pat.media.colour import linear_from_srgb, luminance, srgb_from_linear
from pat.media.raw import light_of

WHITE = 0.97
"""Values from here on count as saturated."""
MEASURED = 0.25
"""Largest relative error of light that counts as measured."""
READ_NOISE = 1.5e-3
"""Variance of read noise over shot noise at white, for weighting exposures: typical of machine vision."""


def merged(frame: Frame, rig: Rig, images: Mapping[str, Float[Tensor, "_ _ _"]], alpha: str) -> Frame:
    """The fused frame, brightness from all cameras, sRGB-encoded, above 1 where alpha's white is exceeded.

    Betas, one band each, are sampled at the frame's depth. Alpha's value is predicted as a weighted sum of
    the bands that are not saturated, fitted where no camera is; it is averaged with alpha's own value by the
    noise and error of each, and replaces it where alpha is saturated. `rig` has the exposures and gains.
    Raises ValueError if hardly a point is within the range of all cameras.
    """
    measured = linear_from_srgb(images[alpha])[0]
    names = [name for name in rig.betas(alpha) if name in images and images[name].shape[0] == 1]
    bands = torch.stack([_at_alpha(frame, rig, images[name], alpha, name) for name in names])
    scale = [light_of(rig[name].sensor, rig[alpha].sensor) for name in names]
    good = torch.stack([b.isfinite() & (b * s < WHITE) for b, s in zip(bands, scale)])
    predicted, noise = _predicted(torch.where(good, bands, 0.0), good, scale, measured)
    weight = torch.where(noise.isfinite(), frame.confidence / noise, 0.0)
    measured_weight = torch.where(measured < WHITE, 1 / (measured + READ_NOISE), 0.0)
    total = weight + measured_weight
    mean = (weight * predicted + measured_weight * measured) / total.clamp(min=1e-12)
    light = torch.where(total > 0, mean, measured)
    light = torch.where((measured >= WHITE) & noise.isfinite(), torch.maximum(predicted, measured), light)
    return frame._replace(image=frame.image + srgb_from_linear(light[None]) - images[alpha])


def _at_alpha(frame: Frame, rig: Rig, image: Tensor, alpha: str, name: str) -> Float[Tensor, "h w"]:
    """Linear light of a beta at alpha's pixels, by depth; NaN where it is not known or outside the image."""
    a, b = rig.pair(alpha, name).cameras
    x, _, valid = b.to(torch.float32).project(a.to(torch.float32).unproject(pixel_grid(a.hw), frame.depth))
    sampled = sample(linear_from_srgb(image)[None], torch.where(valid[..., None], x, -1e3)[None])
    return torch.where(valid & sampled.valid[0], sampled.values[0, 0], torch.nan)


MISPLACED = 0.1
"""Relative error of sampling betas by depth, besides that of the fit."""
FULL_WELL = 10_000.0
"""Electrons at white, for weighting shot noise against errors of the prediction."""


def _predicted(
    bands: Float[Tensor, "m h w"], good: Tensor, scale: Sequence[float], measured: Float[Tensor, "h w"]
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Alpha's value predicted from the bands that are good at a pixel, and its variance, in 1 / FULL_WELL.

    Where none is good the variance is infinite.
    """
    train = good.all(0) & (measured < WHITE) & (measured > 0.05)
    if train.sum() < 100:
        raise ValueError("exposures cannot be merged: hardly a point is within the range of all cameras")
    predicted, noise = torch.zeros_like(measured), torch.full_like(measured, torch.inf)
    for count in range(len(bands), 0, -1):
        for chosen in combinations(range(len(bands)), count):
            some = list(chosen)
            weights, error = _fit(bands[some][:, train], measured[train])
            error = math.hypot(error, MISPLACED)
            value = (weights[:, None, None] * bands[some]).sum(0).clamp(min=0)
            parts = zip(weights, [scale[i] for i in some], bands[some])
            shot = sum((w / s) ** 2 * (b * s + READ_NOISE) for w, s, b in parts)
            variance = shot + FULL_WELL * (error * value) ** 2
            here = good[some].all(0) & noise.isinf()
            predicted, noise = torch.where(here, value, predicted), torch.where(here, variance, noise)
    return predicted, noise


def _fit(bands: Float[Tensor, "m n"], measured: Float[Tensor, " n"]) -> tuple[Float[Tensor, " m"], float]:
    """Weights with which the bands sum up to alpha's value, and the median relative error of the sum."""
    relative = 1 / (measured + 0.02)
    weights = torch.linalg.lstsq((bands * relative).T, (measured * relative)[:, None]).solution[:, 0]
    return weights, float(((weights @ bands - measured) * relative).abs().median())


class DynamicRange(NamedTuple):
    """The darkest and the brightest light that an image measures."""

    low: float
    high: float

    @property
    def stops(self) -> float:
        """log2(high / low)."""
        return float(torch.tensor(self.high / self.low).log2())


def usable_range(measured: Float[Tensor, "*n"], ground_truth: Float[Tensor, "*n"]) -> DynamicRange:
    """Widest run of half-stops of true light in which an image's median relative error is at most a quarter.

    Raises ValueError if there is none.
    """
    values, light = measured.flatten(), ground_truth.flatten()
    bins = (2 * light.clamp(min=1e-7).log2()).floor().long()
    runs: list[list[int]] = [[]]
    for i in range(int(bins.min()), int(bins.max()) + 1):
        here = bins == i
        if here.sum() < 50:
            continue
        right = float(((values[here] - light[here]).abs() / light[here]).median()) <= MEASURED
        runs = [*runs[:-1], [*runs[-1], i]] if right else [*runs, []]
    best = max(runs, key=len)
    if not best:
        raise ValueError("the image measures no light within that error")
    return DynamicRange(2 ** (best[0] / 2), 2 ** ((best[-1] + 1) / 2))


def tone_curve(like: Float[Tensor, "3 h w"]) -> Callable[[Tensor], Tensor]:
    """A function that shows images (sRGB, above 1 too) of the range of light of `like`: Reinhard et al. 2002.

    The logarithmic mean of the light becomes a middle grey, the brightest white; hues stay.
    """
    light = luminance(linear_from_srgb(like.clamp(min=0))[None])
    gain = MIDDLE_GREY / float(light.clamp(min=1e-4).log().mean().exp())
    white = gain * float(light.max())

    def shown(image: Tensor) -> Tensor:
        linear = gain * linear_from_srgb(image.clamp(min=0))
        bright = luminance(linear[None])[0] if len(linear) == 3 else linear
        return srgb_from_linear(linear * (1 + bright / white**2) / (1 + bright)).clamp(0, 1)

    return shown


MIDDLE_GREY = 0.18
CLIPPED = 0.1
"""Light, 1 is alpha's white, above which an error is no noise."""


def missed(image: Float[Tensor, "1 h w"], light: Float[Tensor, "1 h w"]) -> Tensor:
    """A camera's image (3, H, W): red where it is clipped, and measures less of its light by more than
    a quarter; blue where noise exceeds it."""
    value = linear_from_srgb(image)
    wrong, clipped = (value - light).abs() > MEASURED * light, (value < light) & (value > CLIPPED)
    red, blue = (image.new_tensor(rgb)[:, None, None] for rgb in ([0.9, 0.1, 0.1], [0.15, 0.35, 0.95]))
    return torch.where(wrong & clipped, red, torch.where(wrong, blue, image.expand(3, -1, -1)))
