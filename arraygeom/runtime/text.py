"""Short texts for messages: lengths, ranges, shares, depth bounds."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

UNSCALED = "found from images: lengths are multiples of the baseline, not metres"
"""Name of a rig of unknown scale."""
ASSUMED = f"{UNSCALED}; focal lengths are assumed, and the proportions of depth with them"
"""Name of a rig with assumed focal lengths: an interval of its depths would be a guess."""
OPEN = "found from images that leave lines and depth open: of these images alone"
"""Name of a rig whose cameras one homography relates as well as any lines."""
REGISTERED = "registered by a homography each: for scenes about as far away as those of these images"
"""Name of such a rig that several captures agree on."""


def length_unit(rig: Any) -> str:
    """Return the unit of a rig's lengths: "m", or "baselines" for unknown scale."""
    return "baselines" if rig.name in (UNSCALED, ASSUMED) else "m"


def baseline_text(cameras: Mapping[str, Any], unit: str = "m") -> str:
    """Describe the least and largest distance between cameras of known pose, such as "baselines 10-20 mm".

    Args:
        cameras: cameras by name, of batch shapes that broadcast; those without a pose do not count.
        unit: unit of their lengths. For "m" the text names m, cm or mm; for others numbers alone.

    Returns:
        The text; empty for fewer than two cameras of known pose.
    """
    centres = [c.centre.detach() for c in cameras.values() if hasattr(c, "cam_from_world")]
    pairs = [(a - b).norm(dim=-1) for i, a in enumerate(centres) for b in centres[:i]]
    if not pairs:
        return ""
    lengths = torch.cat([d.reshape(-1) for d in torch.broadcast_tensors(*pairs)])
    named = "baselines" if len(pairs) > 1 else "baseline"
    if unit != "m":
        return f"{named} {range_text(lengths, '.3g')}"
    scale, unit = next((s, u) for limit, s, u in UNITS if float(lengths.max()) < limit)
    return f"{named} {range_text(lengths * scale, '.3g')} {unit}"


UNITS = ((0.01, 1e3, "mm"), (1.0, 1e2, "cm"), (float("inf"), 1.0, "m"))
"""Length in metres below which a unit reads better, its factor and name."""


def depth_text(depth: tuple[Tensor, Tensor] | None, unit: str = "m") -> str:
    """Describe a depth range, such as "2-5 m"; empty for None."""
    if depth is None:
        return ""
    near, far = float(depth[0].detach().min()), float(depth[1].detach().max())
    return f"{near:.3g} {unit} to infinity" if far == float("inf") else f"{near:.3g}-{far:.3g} {unit}"


def angle(R: Tensor) -> Tensor:
    """Compute the angle (*b) of rotations (*b, 3, 3), radians, without gradient; exact for small ones too."""
    R = R.detach()
    skew = torch.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1
    )
    return torch.atan2(0.5 * skew.norm(dim=-1), 0.5 * (R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1))


def range_text(values: Tensor, form: str) -> str:
    """Format the least and the largest value, as one if they read alike."""
    low, high = (format(float(v), form) for v in (values.min(), values.max()))
    return low if low == high else f"{low}-{high}"


def share_text(mask: Tensor) -> str:
    """Format the true share of a mask, such as "50 %"; "none" for an empty one."""
    return f"{100 * float(mask.float().mean()):.0f} %" if mask.numel() else "none"


def short(value: object) -> str:
    """Shorten a value for a message: numbers with four digits, at most 60 characters, ASCII."""
    text = re.sub(r"-?\d+\.\d{4,}(?:e[-+]\d+)?", lambda number: f"{float(number[0]):.4g}", ascii(value))
    return text if len(text) <= 60 else f"{text[:57]}..."
