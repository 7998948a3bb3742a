"""What `rs-enumerate-devices -c` prints of a RealSense camera, kept as a text file.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; `Extrinsic from "A" To "B"` takes
points of A into B, in metres, the matrix row by row. The world is the depth camera, or the first stream that
has intrinsics.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from ..camera import Camera
from ..distortion import Distortion
from ..pixels import HW
from ..pose import Pose
from ..rig import Rig
from .source import RigSource

CONVENTION = (
    "first pixel's centre at 0 (shift 0); extrinsics from one stream to another, in metres; world = depth"
)
LONGEST = 1_000_000
INTRINSIC = re.compile(r'^\s*Intrinsic of "([^"]+)"[^\n]*\n((?:\s+[^:\n]+:[^\n]*\n?)+)', re.M)
EXTRINSIC = re.compile(
    r'^\s*Extrinsic from "([^"]+)"\s+To\s+"([^"]+)"\s*:\s*Rotation Matrix:\s*((?:[-+.\deE]+\s+){9})'
    r"\s*Translation Vector:((?:[ \t]+[-+.\deE]+){3})",
    re.M,
)
ENTRY = re.compile(r"^\s*([^:\n]+?)\s*:\s*(.*?)\s*$", re.M)


class Stream(NamedTuple):
    """One stream at one size."""

    name: str
    hw: HW
    fields: dict[str, str]


def recognises(path: Path, head: str) -> bool:
    return path.is_file() and not head.lstrip().startswith(("{", "[")) and _is_report(path, head)


def _is_report(path: Path, head: str) -> bool:
    """The lists of modes before the intrinsics may be longer than what was read of the file."""
    if 'Intrinsic of "' in head:
        return True
    return "Intel RealSense" in head and 'Intrinsic of "' in path.read_bytes()[:LONGEST].decode(
        errors="replace"
    )


def read(source: RigSource) -> Rig:
    """The streams that are images, by name, each at the size that is asked for, else at its largest."""
    text = source.text(LONGEST)
    streams: dict[str, Stream] = {}
    for name, listed in INTRINSIC.findall(text):
        fields = dict(ENTRY.findall(listed))
        sides = " ".join(source.get(fields, side, name) for side in ("Width", "Height"))
        hw = source.size_of(source.numbers_in(sides, (2,), f"{name} Width, Height"), f"{name} Width, Height")
        known = streams.get(name)
        wanted = hw == source.hw if source.hw is not None else known is None or hw > known.hw
        if wanted or known is None:
            streams[name] = Stream(name, hw, fields)
    if not streams:
        raise source.fail(None, "has no `Intrinsic of`: print it with `rs-enumerate-devices -c`")
    poses = {(a, b): (R, t) for a, b, R, t in EXTRINSIC.findall(text)}
    first = "Depth" if "Depth" in streams else next(iter(streams))
    return source.rig(
        (name, _camera(source, stream, _pose(source, poses, first, name))) for name, stream in streams.items()
    )


def _pose(source: RigSource, poses: dict[tuple[str, str], tuple[str, str]], first: str, name: str) -> Pose:
    if name == first:
        return Pose.identity()
    for pair in ((first, name), (name, first)):
        if pair in poses:
            entry = f"Extrinsic from {pair[0]} to {pair[1]}"
            R, t = (source.numbers_in(text, None, entry) for text in poses[pair])
            pose = source.pose(R, t, entry)
            return pose if pair[0] == first else pose.inverse()
    raise source.fail(name, f"has no extrinsic from or to {first}; is the file whole?")


def _camera(source: RigSource, stream: Stream, pose: Pose) -> Camera:
    name, fields = stream.name, stream.fields
    numbers = [source.get(fields, key, name) for key in ("Fx", "Fy", "PPX", "PPY")]
    return Camera(
        K=source.focal_and_centre(
            source.numbers_in(" ".join(numbers), (4,), f"{name} Fx, Fy, PPX, PPY"), name
        ),
        cam_from_world=pose,
        hw=stream.hw,
        distortion=_lens(source, name, fields),
    )


def _lens(source: RigSource, name: str, fields: dict[str, str]) -> Distortion | None:
    """A lens; none of coefficients 0.

    The modified model applies p1 and p2 to points that are distorted already: it is read where they are 0,
    and then the same. The inverse model's polynomial undistorts.
    """
    c = source.numbers_in(fields.get("Coeffs", ""), None, f"{name} Coeffs")
    kind = source.get(fields, "Distortion", name)
    if not c.any():
        return None
    if kind == "Brown Conrady" or (kind == "Modified Brown Conrady" and not c[2:4].any()):
        return source.brown_conrady(c, f"{name} Coeffs")
    if kind == "Kannala Brandt4" and not c[4:].any():  # printed as five numbers
        return source.kannala_brandt(c[:4], f"{name} Coeffs")
    raise source.fail(
        f"{name} Distortion",
        f"is '{kind}' with these coefficients; Brown Conrady, Kannala Brandt4, "
        "and Modified Brown Conrady without tangential terms are read",
    )
