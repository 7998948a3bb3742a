"""A ZED camera's factory calibration, `SN12345.conf`: an INI file with the pair at each resolution.

Source convention: as the maker's own rectification reads it (zed-open-capture, `calibration.hpp`), pixels
with the first centre at 0 (shift 0); OpenCV axes; lenses of OpenCV, fisheye ones where there is a k4 and no
p1; RX, CV, RZ are the rotation vector that takes points of the left camera into the right one, with T along
(Baseline, TY, TZ), in millimetres. There the sign of T is lost, as rectification does not need it; the right
camera is on the right of the left one, so that t = -(Baseline, TY, TZ). World = left camera.
"""

from __future__ import annotations

import configparser
from pathlib import Path

from ..camera import Camera
from ..pixels import HW
from ..pose import Pose
from ..rig import Rig
from .source import Entry, RigSource, pose_of

LONGEST = 100_000
SIZES: dict[str, HW] = {
    "2k": (1242, 2208),
    "fhd1200": (1200, 1920),
    "fhd": (1080, 1920),
    "hd": (720, 1280),
    "svga": (600, 960),
    "vga": (376, 672),
}
"""Of one camera's image, by the name of the resolution; the largest first."""


def recognises(path: Path, head: str) -> bool:
    return path.is_file() and "[LEFT_CAM_" in head.upper()


def read(source: RigSource) -> Rig:
    """Both cameras, `left` and `right`, at the size that is asked for, else at the largest."""
    parser = configparser.ConfigParser(interpolation=None)
    try:
        parser.read_string(source.text(LONGEST).replace(",", "."))  # some systems write a decimal comma
    except configparser.Error as error:
        raise source.fail(
            None, f"is not an INI file ({str(error).splitlines()[0]}); is the file whole?"
        ) from None
    sections = {name.lower(): source.at(dict(parser[name]), name.upper()) for name in parser.sections()}
    there = {
        name: hw for name, hw in SIZES.items() if {f"left_cam_{name}", f"right_cam_{name}"} <= sections.keys()
    }
    listed = ", ".join(f"{w}x{h}" for h, w in there.values())
    if not there:
        raise source.fail(None, f"has no LEFT_CAM and RIGHT_CAM of a known resolution ({', '.join(SIZES)})")
    if source.hw is not None and source.hw not in there.values():
        raise source.fail(None, f"has no cameras of {source.hw[1]}x{source.hw[0]}; it has {listed}")
    name = next(name for name, hw in there.items() if source.hw in (None, hw))
    poses = {"left": Pose.identity(), "right": _pose(sections.get("stereo", source.at({}, "STEREO")), name)}
    return source.rig(
        (side, _camera(sections[f"{side}_cam_{name}"], there[name], pose)) for side, pose in poses.items()
    )


def _pose(stereo: Entry, name: str) -> Pose:
    """Of the right camera: points are R X + t. Offsets have been written for all resolutions at once too."""
    offsets = [stereo.get(f"{key}_{name}", stereo.get(key, "0").value).value for key in ("ty", "tz")]
    t = stereo.at([stereo["baseline"].value, *offsets], "baseline, ty, tz").words()
    rotation = stereo.listed(*(f"{key}_{name}" for key in ("rx", "cv", "rz"))).words()
    return pose_of(rotation, t, metres=-1e-3)


def _camera(fields: Entry, hw: HW, pose: Pose) -> Camera:
    fisheye = "k4" in fields and "p1" not in fields
    keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    c = fields.at([fields.get(key, "0").words().number() for key in keys], ", ".join(keys))
    return Camera(
        K=fields.listed("fx", "fy", "cx", "cy").words().focal_and_centre(),
        cam_from_world=pose,
        hw=hw,
        distortion=c.kannala_brandt() if fisheye else c.brown_conrady(),
    )
