"""The `.camera` files of Strecha's multi-view data: one camera a file, or a folder of them as one rig.

Source convention: K (3 lines), a line of zeros, R (3 lines), C, and the image's size; x ~ K R^T (X - C), so
R's columns are the camera's axes in the world and C is its centre. Pixels with the first centre at 0 (shift
0); the unit is the scene's, taken as metres.

Written by: Strecha's multi-view data, and exporters to it.
Refused: a lens.
Sample: real: rendered views of pycalib's 15 cameras.
"""

from __future__ import annotations

from pathlib import Path

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from ..runtime.text import short
from .source import RigSource


def recognises(path: Path, head: str) -> bool:
    """Return True for a .camera file, or a folder of them."""
    return any(path.glob("*.camera")) if path.is_dir() else path.suffix == ".camera"


def read(source: RigSource) -> Rig:
    """Read the cameras, under the names of their images.

    Raises:
        RigFileError: for a damaged file, a lens, or a folder without such files.
    """
    return source.rig(
        (file.path.name.removesuffix(".camera"), _camera(file)) for file in source.files("*.camera")
    )


def _camera(source: RigSource) -> Camera:
    numbers = source.at(source.text(), "the file").numbers((26,))
    K, skipped, R, centre, wh = numbers.split([9, 3, 9, 3, 2])
    if skipped.any():
        raise source.fail(
            "line 4", f"is {short(skipped.tolist())}: a lens, which is not read: undistort the images first"
        )
    world_from_cam = source.at(R, "lines 5 to 7").rotation()
    return Camera(
        K=source.at(K, "lines 1 to 3").intrinsics(),
        cam_from_world=Pose.from_centre(world_from_cam.mT, centre),
        hw=source.at(wh, "line 9").size(),
    )
