"""The TOML camera arrays of aniposelib and caliscope.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; world->camera, the rotation as a
Rodrigues vector (or a matrix); lengths in the board's unit, taken as metres. caliscope's `rotation_count`
says by how many quarters it rotates a camera's images for display; the numbers are of the images as recorded,
so it is not applied.
"""

from __future__ import annotations

from pathlib import Path

from ..camera import Camera
from ..rig import Rig
from .source import LENS_NAME, Entry, RigSource, pose_of


def recognises(path: Path, head: str) -> bool:
    """Return True for a TOML file, or a text with tables of cameras as aniposelib writes them."""
    return path.suffix == ".toml" or ("[cam" in head and "matrix =" in head)


def read(source: RigSource) -> Rig:
    """Read every camera that is not marked `ignore`, under its name, or else that of its table.

    Raises:
        RigFileError: for a damaged file, or one without such a camera.
    """
    document = source.toml()
    tables = document["cameras"] if isinstance(document.get("cameras").value, dict) else document
    cameras = [(k, fields) for k, fields in tables.items() if isinstance(fields.value, dict)]
    if not any("matrix" in fields for _, fields in cameras):
        raise source.fail("matrix", "is in no table; is this a camera array of aniposelib or caliscope?")
    used = [(k, f) for k, f in cameras if k != "metadata" and not f.value.get("ignore")]
    return source.rig((_name(key, fields), _camera(fields)) for key, fields in used)


def _name(key: str, fields: Entry) -> str:
    return str(fields.get("name", f"cam{key}" if key.isdigit() else key).value)


def _camera(fields: Entry) -> Camera:
    K = fields["matrix"].intrinsics()
    return Camera(
        K=K,
        cam_from_world=pose_of(fields["rotation"], fields["translation"]),
        hw=fields.sized("size", K=K),
        distortion=fields.find(LENS_NAME).of_model(fields.model()),
    )
