"""The TOML camera arrays of aniposelib and caliscope.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; world->camera, the rotation as a
Rodrigues vector (or a matrix); lengths in the board's unit, taken as metres. caliscope's `rotation_count`
says by how many quarters it rotates a camera's images for display; the numbers are of the images as recorded,
so it is not applied.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..camera import Camera
from ..rig import Rig
from .source import RigSource

CONVENTION = "first pixel's centre at 0 (shift 0); world->camera, Rodrigues vectors; metres"


def recognises(path: Path, head: str) -> bool:
    return path.suffix == ".toml" or ("[cam" in head and "matrix =" in head)


def read(source: RigSource) -> Rig:
    """Every camera that is not marked `ignore`, under its name, or else that of its table."""
    document = source.toml()
    tables = document.get("cameras") if isinstance(document.get("cameras"), dict) else document
    cameras = {
        key: fields
        for key, fields in (tables or {}).items()
        if isinstance(fields, dict) and key != "metadata"
    }
    if not any("matrix" in fields for fields in cameras.values()):
        raise source.fail("matrix", "is in no table; is this a camera array of aniposelib or caliscope?")
    used = {key: fields for key, fields in cameras.items() if not fields.get("ignore", False)}
    return source.rig((_name(key, fields), _camera(source, key, fields)) for key, fields in used.items())


def _name(key: str, fields: dict[str, Any]) -> str:
    return str(fields.get("name", f"cam{key}" if key.isdigit() else key))


def _camera(source: RigSource, key: str, fields: dict[str, Any]) -> Camera:
    c, entry = fields.get("distortions"), f"{key}.distortions"
    fisheye = bool(fields.get("fisheye", False))
    rotation, translation = (source.get(fields, k, key) for k in ("rotation", "translation"))
    return Camera(
        K=source.intrinsics(source.get(fields, "matrix", key), f"{key}.matrix"),
        cam_from_world=source.pose(rotation, translation, key),
        hw=source.size_of(source.get(fields, "size", key), f"{key}.size"),
        distortion=source.kannala_brandt(c, entry) if fisheye else source.brown_conrady(c, entry),
    )
