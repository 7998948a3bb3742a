"""multical's calibration.json.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; `camera_poses` of a camera takes
points of the rig's frame into the camera's. An entry "B_to_A" likewise takes points of A into B, whatever its
name suggests; the world is then A. Lengths are in the board's unit, taken as metres.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..camera import Camera
from ..distortion import Distortion
from ..pose import Pose
from ..rig import Rig
from .source import RigSource

CONVENTION = "first pixel's centre at 0 (shift 0); camera<-rig, 'B_to_A' takes A into B; metres"


def recognises(path: Path, head: str) -> bool:
    return '"cameras"' in head and '"image_size"' in head


def read(source: RigSource) -> Rig:
    """The cameras that have a pose, under their names."""
    document = source.json()
    cameras = source.mapping(source.get(document, "cameras", ""), "cameras")
    poses = _poses(source, source.mapping(source.get(document, "camera_poses", ""), "camera_poses"), cameras)
    missing = [name for name in cameras if name not in poses]
    if missing:
        raise source.fail(
            f"camera_poses.{missing[0]}", "is missing; was this camera not calibrated with the others?"
        )
    return source.rig((name, _camera(source, name, cameras[name], poses[name])) for name in cameras)


def _poses(source: RigSource, entries: dict[str, Any], cameras: dict[str, Any]) -> dict[str, Pose]:
    """Poses by camera: those that are stated, then those that follow from others."""
    links = []
    poses: dict[str, Pose] = {}
    for key, fields in entries.items():
        entry = f"camera_poses.{key}"
        R, T = (source.get(source.mapping(fields, entry), letter, entry) for letter in "RT")
        pose = source.pose(R, T, entry)
        if key in cameras:
            poses[key] = pose
            continue
        b, _, a = key.partition("_to_")
        if a not in cameras or b not in cameras:
            raise source.fail(entry, f"names no camera of this file ({', '.join(cameras)})")
        links.append((a, b, pose))
    if not poses and links:
        poses[links[0][0]] = Pose.identity()
    for _ in links:
        poses |= {b: pose @ poses[a] for a, b, pose in links if a in poses and b not in poses}
    return poses


def _camera(source: RigSource, name: str, fields: Any, pose: Pose) -> Camera:
    entry = f"cameras.{name}"
    fields = source.mapping(fields, entry)
    return Camera(
        K=source.intrinsics(source.get(fields, "K", entry), f"{entry}.K"),
        cam_from_world=pose,
        hw=source.size_of(source.get(fields, "image_size", entry), f"{entry}.image_size"),
        distortion=_lens(source, fields, f"{entry}.dist"),
    )


def _lens(source: RigSource, fields: dict[str, Any], entry: str) -> Distortion | None:
    if "fisheye" in str(fields.get("model", "")).lower():
        return source.kannala_brandt(source.get(fields, "dist", entry), entry)
    return source.brown_conrady(fields.get("dist"), entry)
