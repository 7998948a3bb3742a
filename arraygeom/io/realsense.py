"""Output of `rs-enumerate-devices -c` for a RealSense camera, kept as a text file.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; `Extrinsic from "A" To "B"` takes
points of A into B, in metres, the matrix row by row. The world is the depth camera, or the first stream that
has intrinsics.

Written by: `rs-enumerate-devices -c` of librealsense 2, every stream at one size.
Refused: inverse models; modified Brown-Conrady with tangential terms.
Sample: hand-written: realsense.txt, as the tool prints it.
"""

from __future__ import annotations

import re
from pathlib import Path

from ..distortion import Distortion
from ..pixels import HW
from ..pose import Pose
from ..rig import Rig
from .source import Entry, RigSource, decoded, pose_of

LONGEST = 1_000_000
INTRINSIC = re.compile(r'^\s*Intrinsic of "([^"]+)"[^\n]*\n((?:\s+[^:\n]+:[^\n]*\n?)+)', re.M)
EXTRINSIC = re.compile(
    r'^\s*Extrinsic from "([^"]+)"\s+To\s+"([^"]+)"\s*:\s*Rotation Matrix:\s*((?:[-+.\deE]+\s+){9})'
    r"\s*Translation Vector:((?:[ \t]+[-+.\deE]+){3})",
    re.M,
)
ENTRY = re.compile(r"^\s*([^:\n]+?)\s*:\s*(.*?)\s*$", re.M)


def recognises(path: Path, head: str) -> bool:
    """Return True for a text with intrinsics; the lists of modes before them may be longer than `head`."""
    if not path.is_file() or head.lstrip().startswith(("{", "[")):
        return False
    whole = decoded(path.read_bytes()[:LONGEST]) if "Intel RealSense" in head else head
    return 'Intrinsic of "' in whole


def read(source: RigSource) -> Rig:
    """Read the streams that are images, by name, each at its largest (highest) size, or the requested.

    A stream without the requested size is read at the first size that is listed. "Depth", or else the first
    stream, is the world; lengths are metres.

    Raises:
        RigFileError: for a damaged file, no stream, one not related to the world's, or an unsupported lens.
    """
    text = source.text(LONGEST)
    streams: dict[str, tuple[HW, Entry]] = {}
    for name, listed in INTRINSIC.findall(text):
        fields = source.at(dict(ENTRY.findall(listed)), name)
        hw = fields.listed("Width", "Height").size()
        fields.use()  # of the streams that are left out, too
        earlier = streams.get(name)
        wanted = hw == source.hw if source.hw is not None else earlier is None or hw > earlier[0]
        if wanted or earlier is None:
            streams[name] = hw, fields
    if not streams:
        raise source.fail(None, "has no `Intrinsic of`: print it with `rs-enumerate-devices -c`")
    poses = {(a, b): (R, t) for a, b, R, t in EXTRINSIC.findall(text)}
    first = "Depth" if "Depth" in streams else next(iter(streams))
    return source.rig(
        (name, fields.camera(_pose(source, poses, first, name), hw=hw, distortion=_lens(fields)))
        for name, (hw, fields) in streams.items()
    )


def _pose(source: RigSource, poses: dict[tuple[str, str], tuple[str, str]], first: str, name: str) -> Pose:
    if name == first:
        return Pose.identity()
    for a, b in ((first, name), (name, first)):
        if (a, b) in poses:
            R, t = (source.at(text, f"Extrinsic from {a} to {b}") for text in poses[a, b])
            pose = pose_of(R, t)
            return pose if a == first else pose.inverse()
    raise source.fail(name, f"has no extrinsic from or to {first}; is the file whole?")


def _lens(fields: Entry) -> Distortion | None:
    """Read a lens; None if all coefficients are 0.

    The modified model applies p1 and p2 to points that are distorted already: it is read where they are 0,
    and then the same. The inverse model's polynomial undistorts.
    """
    listed, kind = fields.get("Coeffs", ""), fields["Distortion"]
    c = listed.numbers()
    if not c.any():
        return None
    if kind.value == "Brown Conrady" or (kind.value == "Modified Brown Conrady" and not c[2:4].any()):
        return listed.brown_conrady()
    if kind.value == "Kannala Brandt4" and not c[4:].any():  # printed as five numbers
        return fields.at(c[:4], "Coeffs").kannala_brandt()
    raise kind.fail(
        f"is '{kind.value}' with these coefficients; Brown Conrady, Kannala Brandt4, "
        "and Modified Brown Conrady without tangential terms are read"
    )
