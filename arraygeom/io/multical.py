"""multical's calibration.json.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; `camera_poses` of a camera takes
points of the rig's frame into the camera's. An entry "B_to_A" likewise takes points of A into B, whatever its
name suggests; the world is then A. Lengths are in the board's unit, taken as metres.
"""

from __future__ import annotations

from pathlib import Path

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from .source import LENS_NAME, Entry, RigSource, pose_of


def recognises(path: Path, head: str) -> bool:
    """Return True for a text with multical's keys."""
    return '"cameras"' in head and ('"image_size"' in head or '"camera_poses"' in head)


def read(source: RigSource) -> Rig:
    """Read the cameras, all of which must have a pose, under their names.

    Raises:
        RigFileError: for a damaged file, or a camera without a pose.
    """
    document = source.json()
    cameras = dict(document["cameras"].items())
    poses = _poses(document["camera_poses"], cameras)
    missing = [name for name in cameras if name not in poses]
    if missing:
        raise source.fail(
            f"camera_poses.{missing[0]}", "is missing; was this camera not calibrated with the others?"
        )
    return source.rig((name, _camera(fields, poses[name])) for name, fields in cameras.items())


def _poses(entries: Entry, cameras: dict[str, Entry]) -> dict[str, Pose]:
    """Return poses by camera: those that are stated, then those that follow from others."""
    links = []
    poses: dict[str, Pose] = {}
    for key, fields in entries.items():
        pose = pose_of(fields["R"], fields["T"])
        if key in cameras:
            poses[key] = pose
            continue
        b, _, a = key.partition("_to_")
        if a not in cameras or b not in cameras:
            raise fields.fail(f"names no camera of this file ({', '.join(cameras)})")
        links.append((a, b, pose))
    if not poses and links:
        poses[links[0][0]] = Pose.identity()
    for _ in links:
        poses |= {b: pose @ poses[a] for a, b, pose in links if a in poses and b not in poses}
    return poses


def _camera(fields: Entry, pose: Pose) -> Camera:
    K = fields["K"].intrinsics()
    return Camera(
        K=K,
        cam_from_world=pose,
        hw=fields.sized("image_size", K=K),
        distortion=fields.find(LENS_NAME).of_model(fields.model()),
    )
