"""Self-check of a rendered array: depth and cameras of one view must predict the other views."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from arraygeom import Pair, Rig, pixel_grid, sample

from .rendered import RenderedFrame, depth_between


@dataclass(frozen=True, kw_only=True)
class CheckLimits:
    """Limits that a rendered scene must keep.

    Attributes:
        error: largest 95th percentile, in pixels, of the error of points that two views see, projected forth
            and back by both depths.
        shift: largest displacement of predicted colours, pixels.
        contradicted: largest share of points where a view looks through a surface that another one sees.
        dark: largest share of pixels below 0.004 in all colours.
        bright: largest share of pixels above 1 in all colours.
        texture: least share of 8x8 patches with contrast above 2 %.
        overlap: least share of a view's pixels of known depth that one other view sees.
    """

    error: float = 0.02
    shift: float = 0.25
    contradicted: float = 0.01
    dark: float = 0.5
    bright: float = 0.25
    texture: float = 0.3
    overlap: float = 0.1


def check_views(
    rig: Rig, frames: Mapping[str, RenderedFrame], limits: CheckLimits = CheckLimits()
) -> dict[str, Any]:
    """Check one frame of every camera against the other cameras and the limits.

    Args:
        rig: calibrated cameras.
        frames: one frame of each camera, by name.
        limits: limits to keep.

    Returns:
        A document for JSON: `views`, the `view_figures` by camera; `pairs`, the `pair_figures` by "alpha >
        beta" (frames of different times make no pair); `reasons`, texts for refusal; and `accepted`, True
        without reasons. A camera in no pair is checked by its own image alone.

    Raises:
        ValueError: for a pair with a camera that is unknown or not calibrated.
    """
    views = {name: view_figures(frame) for name, frame in frames.items()}
    together = [(a, b) for a, b in permutations(frames, 2) if frames[a].time == frames[b].time]
    pairs = {f"{a} > {b}": pair_figures(rig.pair(a, b), frames[a], frames[b]) for a, b in together}
    reasons = [r for name, figures in views.items() for r in _view_reasons(name, figures, limits)]
    reasons += [r for name, figures in pairs.items() for r in _pair_reasons(name, figures, limits)]
    for name in sorted({a for a, _ in together}):
        overlap = max(pairs[f"{a} > {b}"]["visible"] for a, b in together if a == name)
        if overlap < limits.overlap:
            least = f"at least {limits.overlap:.0%}"
            reasons.append(f"{name}: the other cameras see {overlap:.0%} of what it sees ({least})")
    return {"accepted": not reasons, "reasons": reasons, "views": views, "pairs": pairs}


def view_figures(frame: RenderedFrame) -> dict[str, float]:
    """Measure brightness, texture and depths of one image.

    Returns:
        Figures to four digits by name: "mean" brightness, linear; shares, 0..1, of pixels that are "dark" or
        "bright" (`CheckLimits`), of patches with "texture" and of pixels "covered" by a surface; "near" and
        "far" in metres, infinite if nothing is hit.
    """
    finite = frame.depth.isfinite()
    depths = frame.depth[finite] if finite.any() else frame.depth.new_tensor([torch.inf])
    return _rounded(
        {
            "mean": frame.rgb.mean(),
            "dark": (frame.rgb.amax(0) < 0.004).float().mean(),
            "bright": (frame.rgb.amin(0) > 1).float().mean(),
            "texture": texture(frame.rgb),
            "covered": finite.float().mean(),
            "near": depths.min(),
            "far": depths.max(),
        }
    )


def texture(rgb: Float[Tensor, "3 h w"], patch: int = 8) -> Float[Tensor, ""]:
    """Compute the share, a scalar, of patches whose brightness (mean of the channels, clipped to 0..1) has a
    standard deviation above 2 % of its mean, or of 0.01 if the mean is less.

    Args:
        rgb: image in linear light.
        patch: side of a patch, pixels; the image's shorter side if that is less. Only whole patches count.
    """
    grey = rgb.mean(0)[None, None].clamp(0, 1)
    mean = avg_pool2d(grey, min(patch, *rgb.shape[1:]))
    square = avg_pool2d(grey**2, min(patch, *rgb.shape[1:]))
    return ((square - mean**2).clamp(min=0).sqrt() > 0.02 * mean.clamp(min=0.01)).float().mean()


def pair_figures(pair: Pair, here: RenderedFrame, there: RenderedFrame) -> dict[str, float]:
    """Measure how well alpha's depth predicts beta's view, at up to 200,000 pixels.

    Args:
        pair: alpha and beta.
        here: alpha's frame.
        there: beta's frame, of the same time.

    Returns:
        Figures by name. Shares of alpha's pixels of known depth: `inside` beta's image, `visible` there
        (projected back by beta's depth to within a pixel), `hidden` behind something nearer, `contradicted`
        in front of beta's surface; points beside an edge in beta, and where beta's depth is not finite, count
        for none of the last three. Of visible points: `median`, `p95` and `p99` of the error in alpha's
        pixels, `colour`, the median difference relative to brightness, and `shift`, the displacement in
        pixels that explains most of it. Without visible points only the shares; without known depth all 0.

    Raises:
        ValueError: unless both cameras are calibrated.
    """
    alpha, beta = (camera.to(dtype=torch.float64) for camera in pair.cameras)
    x, depth, index = _chosen(here, 200_000)
    ahead = beta.project(alpha.unproject(x, depth))
    inside = ahead.valid & beta.contains(ahead.x.nan_to_num(-1e9))
    if not inside.any():
        return {"inside": 0.0, "visible": 0.0, "hidden": 0.0, "contradicted": 0.0}
    total, x, index = len(depth), x[inside], index[inside]
    target, predicted = ahead.x[inside], ahead.depth[inside]
    recorded, clean = depth_between(there.depth, there.index, target)
    clean = clean & recorded.isfinite()
    recorded = torch.where(clean, recorded, predicted)
    back = alpha.project(beta.unproject(target, recorded))
    error = (back.x - x).norm(dim=-1)
    visible = clean & back.valid & (error < 1)
    nearer = recorded < predicted
    figures = {
        "inside": inside.double().mean(),
        "visible": visible.sum() / total,
        "hidden": (clean & ~visible & nearer).sum() / total,
        "contradicted": (clean & ~visible & ~nearer).sum() / total,
    }
    if visible.any():
        for name, share in ("median", 0.5), ("p95", 0.95), ("p99", 0.99):
            figures[name] = error[visible].quantile(share)
        figures["colour"], figures["shift"] = _compared(here, x[visible], there, target[visible])
    return _rounded(figures)


def _chosen(frame: RenderedFrame, most: int) -> tuple[Tensor, Tensor, Tensor]:
    """Positions, depth and index of pixels of finite depth, subsampled."""
    grid = pixel_grid((frame.depth.shape[0], frame.depth.shape[1]), dtype=torch.float64)
    finite = frame.depth.isfinite()
    step = max(1, -(-int(finite.sum()) // most))
    return grid[finite][::step], frame.depth[finite][::step].double(), frame.index[finite][::step]


def _compared(here: RenderedFrame, x: Tensor, there: RenderedFrame, target: Tensor) -> tuple[Tensor, Tensor]:
    """`colour` and `shift` of `pair_figures`."""
    slopes = torch.cat(torch.gradient(here.rgb, dim=(-1, -2)))[None]
    mine, dx, dy = sample(torch.cat([here.rgb[None], slopes], 1).double(), x[None]).values[0].split(3)
    difference = sample(there.rgb[None].double(), target[None]).values[0] - mine
    size = difference.abs().mean(0)
    keep = size <= 3 * size.median()
    A = torch.stack([dx[:, keep], dy[:, keep]], -1).flatten(0, 1)
    normal = A.T @ A + 1e-9 * torch.eye(2, dtype=A.dtype)
    shift = torch.linalg.solve(normal, A.T @ difference[:, keep].flatten())
    return (size / mine.mean(0).clamp(min=0.01)).median(), shift.norm()


def _view_reasons(name: str, figures: Mapping[str, float], limits: CheckLimits) -> Iterator[str]:
    if figures["dark"] > limits.dark:
        yield f"{name}: {figures['dark']:.0%} of the image is black (at most {limits.dark:.0%})"
    if figures["bright"] > limits.bright:
        yield f"{name}: {figures['bright']:.0%} of the image is saturated (at most {limits.bright:.0%})"
    if figures["texture"] < limits.texture:
        yield f"{name}: {figures['texture']:.0%} of the image has texture (at least {limits.texture:.0%})"


def _pair_reasons(name: str, figures: Mapping[str, float], limits: CheckLimits) -> Iterator[str]:
    if figures.get("p95", 0.0) > limits.error:
        yield f"{name}: depth misses pixels by {figures['p95']:.3f} (at most {limits.error:g})"
    if figures.get("shift", 0.0) > limits.shift:
        yield f"{name}: colours are displaced by {figures['shift']:.2f} pixels (at most {limits.shift:g})"
    if figures["contradicted"] > limits.contradicted:
        yield f"{name}: {figures['contradicted']:.1%} of the points are seen through"


def _rounded(figures: Mapping[str, Tensor]) -> dict[str, float]:
    return {name: float(f"{float(value):.4g}") for name, value in figures.items()}
