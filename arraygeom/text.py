"""Cameras, rigs and what fields answer in one short line, and rigs as a table for notebooks."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from .sensor import Band, Curve, Sensor

if TYPE_CHECKING:
    from .batching import Batched
    from .camera import View
    from .distortion import Distortion
    from .pose import Pose
    from .rig import Rig
    from .segments import Positions, Segments


def view_text(view: View) -> str:
    """Size, focal length, lens and response: "741x497 f=999 rgb"."""
    return " ".join(part for part in _facts(view) if part)


def response_text(sensor: Sensor) -> str:
    """The spectral response in a word or two, if one is stated."""
    response = sensor.response
    if isinstance(response, Band):
        return f"{response.centre:g}+-{response.width / 2:g} nm"
    if isinstance(response, Curve):
        return f"{min(response.wavelength):g}-{max(response.wavelength):g} nm"
    return response or ""


def distortion_text(lens: Distortion) -> str:
    """Model and coefficients."""
    numbers = "" if lens.batch_shape else " " + " ".join(f"{c:.4g}" for c in lens.coefficients.tolist())
    return lens.model + numbers


def pose_text(pose: Pose) -> str:
    """Angle and translation: "rotation 1.20 deg, t (0.193, 0, 0) m"."""
    if pose.batch_shape:
        return f"{_range(angle(pose.R).rad2deg(), '.3g')} deg"
    t = ", ".join(f"{v:.4g}" for v in pose.t.tolist())
    return f"rotation {float(angle(pose.R).rad2deg()):.2f} deg, t ({t}) m"


def segments_text(s: Segments) -> str:
    """The share that is valid and the median length."""
    length = s.length[s.valid]
    median = f", median length {float(length.detach().median()):.1f} px" if length.numel() else ""
    return f"{_share(s.valid)} valid{median}"


def positions_text(p: Positions) -> str:
    """Number of samples and the share that counts."""
    return f"{p.mask.shape[-1]} samples each, {_share(p.mask)} valid"


def rig_text(rig: Rig) -> str:
    """ "mono 741x497 f=999, colour 741x497 f=999 rgb; baseline 19.3 cm; 2-5 m"."""
    cameras = ", ".join(f"{name} {view_text(view)}" for name, view in rig.cameras.items())
    return "; ".join(part for part in (cameras, baseline_text(rig.cameras), depth_text(rig.depth)) if part)


def baseline_text(cameras: Mapping[str, Any]) -> str:
    """Distances between the cameras whose poses are known, in a unit that suits them."""
    centres = [c.centre.detach() for c in cameras.values() if hasattr(c, "cam_from_world")]
    pairs = [(a - b).norm(dim=-1) for i, a in enumerate(centres) for b in centres[:i]]
    if not pairs:
        return ""
    metres = torch.cat([d.reshape(-1) for d in torch.broadcast_tensors(*pairs)])
    scale, unit = next((s, u) for limit, s, u in UNITS if float(metres.max()) < limit)
    return f"baseline{'s' if len(pairs) > 1 else ''} {_range(metres * scale, '.3g')} {unit}"


UNITS = ((0.01, 1e3, "mm"), (1.0, 1e2, "cm"), (float("inf"), 1.0, "m"))
"""Below which length (metres) another unit reads better, its factor and name."""


def depth_text(depth: tuple[Tensor, Tensor] | None) -> str:
    """The depth range: "2-5 m"."""
    if depth is None:
        return ""
    near, far = float(depth[0].detach().min()), float(depth[1].detach().max())
    return f"{near:.3g} m to infinity" if far == float("inf") else f"{near:.3g}-{far:.3g} m"


def rig_html(rig: Rig) -> str:
    """A table of the cameras, every value escaped."""
    rows = [("camera", "size", "focal length", "lens", "response"), *((n, *_facts(v)) for n, v in rig.cameras.items())]
    cells = ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows]
    facts = (rig.name, batch_text(rig), baseline_text(rig.cameras), depth_text(rig.depth))
    caption = escape("; ".join(fact for fact in facts if fact))
    return f"<table><caption>{caption}</caption>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"


def batch_text(value: Batched) -> str:
    """ "batch of 5", or nothing for one item."""
    return f"batch of {'x'.join(map(str, value.batch_shape))}" if value.batch_shape else ""


def angle(R: Tensor) -> Tensor:
    """The angle of a rotation, radians; exact for small ones too."""
    R = R.detach()
    skew = torch.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)
    return torch.atan2(0.5 * skew.norm(dim=-1), 0.5 * (R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1))


def _facts(view: Any) -> tuple[str, str, str, str]:
    """Size, focal length (pixels; if calibrated), lens model and response."""
    lens, focal = getattr(view, "distortion", None), ""
    if hasattr(view, "cam_from_world"):
        focal = "f=" + _range(view.K.detach()[..., :2, :2].det().abs().sqrt(), ".4g")
    return f"{view.hw[1]}x{view.hw[0]}", focal, lens.model if lens else "", response_text(view.sensor)


def _range(values: Tensor, form: str) -> str:
    low, high = (format(float(v), form) for v in (values.min(), values.max()))
    return low if low == high else f"{low}-{high}"


def _share(mask: Tensor) -> str:
    return f"{100 * float(mask.float().mean()):.0f} %" if mask.numel() else "none"
