"""Numbers of a rig by which `fuse(differentiable=True)` has no gradient, found before the work."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom import Rig

from ..networks.protocol import FusionNetwork
from .fuse import FuseSettings, fuse_frame
from .views import range_of

LONGEST = 96
"""Pixels of the longest side of an image on which gradients are tried."""


def without_gradient(
    images: Mapping[str, Tensor],
    rig: Rig,
    *,
    alpha: str,
    network: FusionNetwork,
    settings: FuseSettings = FuseSettings(),
    free: tuple[str, ...] = ("*",),
) -> dict[str, tuple[str, ...]]:
    """Name the rig's parameters by which the fused image, or its depth, has no gradient.

    The images are fused as `fuse_frame` would, at no more than 96 pixels a side. The derivative of every
    pixel is 0 by parameters of a camera that is not used, of which a field makes no use, or with look-ups at
    whole pixels.

    Args:
        images: tensors (C, H, W) by camera, of the rig's sizes. Others' do not count.
        settings: settings of fusion, without `max_memory` and `noise`.
        free: patterns of the parameters to look at, as for `Rig.parameters`.

    Returns:
        Names of the parameters, under "image" and under "depth".

    Raises:
        ValueError: as `fuse_frame` and `Rig.parameters`, and for a field that only fits full-size images.
        TypeError, NotImplementedError: as `fuse_frame`.
    """
    small = {name: image for name, image in images.items() if name in rig}
    for name, image in small.items():
        h, w = rig[name].hw
        range_of(name, image, (h, w), exposed=True)
        share = min(1.0, LONGEST / max(h, w))
        hw = max(1, round(h * share)), max(1, round(w * share))
        small[name], rig = interpolate(image[None].float(), hw, mode="area")[0], rig.resize(name, hw)
    changes = rig.parameters(free=free)
    there = rig.perturbed(changes)
    frame = fuse_frame(small, there, alpha=alpha, network=network, settings=settings, differentiable=True)
    depth = torch.where(frame.depth.isfinite(), frame.depth, 0.0)
    return {name: _unmoved(values, changes) for name, values in (("image", frame.image), ("depth", depth))}


def _unmoved(values: Tensor, changes: Mapping[str, Tensor]) -> tuple[str, ...]:
    """The names of changes by which a random sum of values has no derivative but 0."""
    if not values.requires_grad:
        return tuple(changes)
    weights = torch.randn(values.shape, generator=torch.Generator().manual_seed(0)).to(values)
    slopes = torch.autograd.grad((weights * values).sum(), [*changes.values()], None, True, allow_unused=True)
    return tuple(name for name, s in zip(changes, slopes) if s is None or not bool((s != 0).any()))
