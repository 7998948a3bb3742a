"""Cameras of a JSON, YAML, TOML or XML file under usual names, of aniposelib, caliscope, multical, pycalib.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes and lenses; R and t, or
`world_to_cam`, `extrinsic` and the like, take points of the world into the camera's frame; for a pair without
those, R and T at the top take points of the first camera into the second; lengths in the file's unit, taken
as metres. caliscope's `rotation_count` is of display only, and not applied. multical's `camera_poses` take
points of the rig's frame into the camera's; its entry "B_to_A" takes points of A into B, whatever the name
suggests, and the world is then A.

Written by: aniposelib, caliscope, multical, pycalib, and scripts: K, lens, size, R and t under usual names,
of one camera, a pair, lists, or a table each.
Refused: several cameras of which one has no place; caliscope's ignored cameras are left out.
Sample: real: caliscope's four cameras, pycalib's fifteen; hand-written: aniposelib.toml, multical.json.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from .source import K_NAME, LENS_NAME, PINHOLE_NAMES, R_NAME, T_NAME, Entry, RigSource, plain, pose_of

SIDES = ("left", "right")
CAMERA = r"(cam(era)?)?(\d+|left|right|[lr])"
"""Pattern of the names of a camera's table, in small letters without signs."""


def recognises(path: Path, head: str) -> bool:
    """Return True for a text in one of these languages with a name of K or of a focal length."""
    if path.suffix not in (".json", ".toml", ".yaml", ".yml", ".xml") and not head.lstrip().startswith("{"):
        return False
    names = map(plain, re.findall(r"([A-Za-z][\w .-]{0,60}?)[\"']?\s*[:=]\s*(?=[\[{\d\s-])", head))
    wanted = re.compile(rf"(left|right|[lr])?({K_NAME}|{PINHOLE_NAMES[0]})(left|right|[lr\d])?")
    return any(wanted.fullmatch(name) for name in names)


def read(source: RigSource) -> Rig:
    """Read one camera; a pair; lists K, R, t, d over the cameras; or a table for each (`cameras_of`).

    Raises:
        RigFileError: for a damaged file, and as `cameras_of`.
    """
    return source.rig(cameras_of(source.document(), alone="cam0"))


def cameras_of(nodes: Entry, *, alone: str) -> Iterator[tuple[str, Camera]]:
    """Yield the cameras of a document with their names: stated, their tables', left and right, or cam0 ...

    The world is the first of a pair whose R and T are at the top, else the one of the stated poses; a single
    camera without a pose is at its origin. Lengths are in the file's unit. A size that is not stated is the
    requested one, else guessed, with a warning.

    Args:
        alone: name of a single camera for which none is stated.

    Raises:
        RigFileError: for a camera without K, one of several without a pose, unequal lists, damaged numbers.
    """
    K, R, t = (nodes.find(name) for name in (K_NAME, R_NAME, T_NAME))
    pair, origin = R.value is not None and t.value is not None, Pose.identity()
    both = next((ends for ends in ("01", "12") if all(nodes.find(K_NAME, end).value for end in ends)), "")
    if both:
        if not pair:
            raise nodes.fail("R, T are missing: put the pair's extrinsics.yml beside its intrinsics.yml")
        for side, name, pose in zip(both, SIDES, (origin, pose_of(R, t))):
            yield str(nodes.get(f"name{side}", name).value), nodes.camera(pose, side=side)
    elif _is_listed(K):
        yield from _of_lists(nodes)
    elif K.value is None and (tables := _tables(nodes)):
        names = {
            key: str(fields.get("name", f"cam{key}" if key.isdigit() else key).value)
            for key, fields in tables.items()
        }
        if "camera_poses" in nodes:
            poses = _linked_poses(nodes["camera_poses"], tables)
            names = dict(zip(tables, tables))
        else:
            poses = {key: fields.pose() for key, fields in tables.items()}
        if len(poses) == 2 and pair and not any(poses.values()):
            poses = dict(zip(poses, (origin, pose_of(R, t))))
        for key, fields in tables.items():
            yield names[key], fields.camera(poses[key] or (origin if len(tables) == 1 else None))
    elif K.value is None and pair:
        raise nodes.fail("M1 is missing: a pair's R and T are here without its intrinsics.yml beside them")
    else:
        yield str(nodes.get("camera_name", alone).value), nodes.camera(nodes.pose() or origin)


def _is_listed(K: Entry) -> bool:
    return isinstance(K.value, list) and K.tensor().numel() not in (4, 9)


def _of_lists(nodes: Entry) -> Iterator[tuple[str, Camera]]:
    """Yield the cameras of lists K, R, t, and d."""
    K, R, t, d = (nodes.find(name) for name in (K_NAME, R_NAME, T_NAME, LENS_NAME))
    lists = [entry.each() for entry in (K, R, t)]
    lists.append(d.each() if d.value else [d] * len(lists[0]))
    if len({len(entries) for entries in lists}) > 1:
        counts = "{}, {}, {} and {}".format(*map(len, lists))
        raise nodes.at(None, "K, R, t, d").fail(f"have {counts} cameras; they are lists of equal length")
    word = nodes.model()
    for i, (matrix, rotation, translation, lens) in enumerate(zip(*lists)):
        pose = pose_of(rotation, translation)
        yield f"cam{i}", nodes.camera(pose, K=matrix.intrinsics(), distortion=lens.of_model(word))


def _tables(nodes: Entry) -> dict[str, Entry]:
    """Return the mappings that describe a camera each, by their keys, without those to be ignored."""
    inner = nodes.get("cameras")
    if isinstance(inner.value, list):
        named = {f"cam{i}": fields for i, fields in enumerate(inner.each())}
    else:
        home = inner if inner.is_table else nodes
        named = {str(key): home.at(value, str(key)) for key, value in home.value.items()}
    return {
        key: fields
        for key, fields in named.items()
        if fields.is_table
        and not fields.value.get("ignore")
        and (inner.value is not None or re.fullmatch(CAMERA, plain(key)) or fields.has_K)
    }


def _linked_poses(stated: Entry, cameras: Mapping[str, Entry]) -> dict[str, Pose]:
    """Return multical's poses by camera: those that are stated, then those that follow from "B_to_A"."""
    links = []
    poses: dict[str, Pose] = {}
    for key, fields in stated.items():
        pose = pose_of(fields["R"], fields["T"])
        b, _, a = key.partition("_to_")
        if key in cameras:
            poses[key] = pose
        elif a not in cameras or b not in cameras:
            raise fields.fail(f"names no camera of this file ({', '.join(cameras)})")
        else:
            links.append((a, b, pose))
    if not poses and links:
        poses[links[0][0]] = Pose.identity()
    for _ in links:
        poses |= {b: pose @ poses[a] for a, b, pose in links if a in poses and b not in poses}
    if missing := [name for name in cameras if name not in poses]:
        raise stated.at(None, missing[0]).fail("is missing; was this camera not calibrated with the others?")
    return poses
