"""BoofCV's stereo.yaml and intrinsic.yaml.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; `rightToLeft` takes points of the
right camera into the left one, so it is inverted here; the world is the left camera. Lengths are in the
board's unit, which the file does not state: they are taken as metres (use `scale=0.001` for a board measured
in millimetres).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from .source import RigSource

CONVENTION = (
    "first pixel's centre at 0 (shift 0); rightToLeft inverted, world = left camera; the board's unit"
)
MODELS = ("pinhole_radial_tangential", "pinhole")


def recognises(path: Path, head: str) -> bool:
    return "pinhole_radial_tangential" in head or "rightToLeft" in head


def read(source: RigSource) -> Rig:
    """The pair "left", "right", or a single "camera"."""
    document = source.yaml()
    if "pinhole" in document:
        return source.rig([("camera", _camera(source, document, "camera", Pose.identity()))])
    relative = source.mapping(source.get(document, "rightToLeft", ""), "rightToLeft")
    t = [source.get(relative, axis, "rightToLeft") for axis in "xyz"]
    left_from_right = source.pose(source.get(relative, "rotation", "rightToLeft"), t, "rightToLeft")
    poses = {"left": Pose.identity(), "right": left_from_right.inverse()}
    return source.rig(
        (side, _camera(source, source.mapping(source.get(document, side, ""), side), side, pose))
        for side, pose in poses.items()
    )


def _camera(source: RigSource, fields: dict[str, Any], entry: str, pose: Pose) -> Camera:
    model = fields.get("model", MODELS[0])
    if model not in MODELS:
        raise source.fail(f"{entry}.model", f"is '{model}'; supported: {', '.join(MODELS)}")
    pinhole = source.mapping(source.get(fields, "pinhole", entry), f"{entry}.pinhole")
    f = {
        k: source.number(source.get(pinhole, k, f"{entry}.pinhole"), f"{entry}.{k}")
        for k in ("fx", "fy", "cx", "cy")
    }
    skew = source.number(pinhole.get("skew", 0.0), f"{entry}.skew")
    K = source.intrinsics([[f["fx"], skew, f["cx"]], [0, f["fy"], f["cy"]], [0, 0, 1]], f"{entry}.pinhole")
    width, height = (source.get(pinhole, k, f"{entry}.pinhole") for k in ("width", "height"))
    hw = source.size(width, height, f"{entry}.width, height")
    lens = fields.get("radial_tangential")
    c = (
        None
        if lens is None
        else _coefficients(source, source.mapping(lens, entry), f"{entry}.radial_tangential")
    )
    return Camera(K=K, cam_from_world=pose, hw=hw, distortion=source.brown_conrady(c, entry))


def _coefficients(source: RigSource, lens: dict[str, Any], entry: str) -> Tensor:
    """k1 k2 p1 p2 k3 of `radial` (up to three numbers), t1 and t2."""
    radial = source.numbers(lens.get("radial") or [], None, entry)
    if len(radial) > 3:
        raise source.fail(entry, f"has {len(radial)} radial coefficients; at most 3 are supported")
    k = torch.nn.functional.pad(radial, (0, 3 - len(radial)))
    t = source.numbers([lens.get("t1", 0.0), lens.get("t2", 0.0)], (2,), entry)
    return torch.cat([k[:2], t, k[2:]])
