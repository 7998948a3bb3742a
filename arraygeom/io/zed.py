"""A ZED camera's factory calibration, `SN12345.conf`: an INI file with the pair at each resolution.

Source convention: as the maker's own rectification reads it (zed-open-capture, `calibration.hpp`), pixels
with the first centre at 0 (shift 0); OpenCV axes; lenses of OpenCV, in the camera's section or in
LEFT_DISTO and RIGHT_DISTO, fisheye ones where there is a k4 and no p1; RX, CV, RZ are the rotation vector
that takes points of the left camera into the right one. T = (-Baseline, TY, TZ), in millimetres, as its
calibration tool (zed-opencv-calibration) writes them. World = left camera; a file with left sections alone
is one camera, `left`.
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
    "4k": (2160, 3840),
    "qhdplus": (1800, 3200),
    "2k": (1242, 2208),
    "fhd1200": (1200, 1920),
    "fhd": (1080, 1920),
    "hd": (720, 1280),
    "svga": (600, 960),
    "vga": (376, 672),
}
"""Height and width of one camera's image, by the name of the resolution; the largest first."""


def recognises(path: Path, head: str) -> bool:
    """Return True for a text with sections of the left camera."""
    return path.is_file() and "[LEFT_CAM_" in head.upper()


def read(source: RigSource) -> Rig:
    """Read the cameras `left` and `right`, at the requested size, else at the largest.

    Raises:
        RigFileError: for a damaged file, no camera of a known or of the requested size, or missing numbers.
    """
    parser = configparser.ConfigParser(interpolation=None)
    try:
        parser.read_string(source.text(LONGEST).replace(",", "."))  # some systems write a decimal comma
    except configparser.Error as error:
        raise source.fail(
            None, f"is not an INI file ({str(error).splitlines()[0]}); is the file whole?"
        ) from None
    sections = {name.lower(): source.at(dict(parser[name]), name.upper()) for name in parser.sections()}
    sides = [side for side in ("left", "right") if any(name.startswith(f"{side}_cam_") for name in sections)]
    there = {
        name: hw for name, hw in SIZES.items() if all(f"{side}_cam_{name}" in sections for side in sides)
    }
    listed = ", ".join(f"{w}x{h}" for h, w in there.values())
    if not there:
        raise source.fail(None, f"has no LEFT_CAM and RIGHT_CAM of a known resolution ({', '.join(SIZES)})")
    if source.hw is not None and source.hw not in there.values():
        raise source.fail(None, f"has no cameras of {source.hw[1]}x{source.hw[0]}; it has {listed}")
    name = next(name for name, hw in there.items() if source.hw in (None, hw))
    poses = {"left": Pose.identity()}
    if "right" in sides:
        poses["right"] = _pose(sections.get("stereo", source.at({}, "STEREO")), name)
    return source.rig(
        (side, _camera(sections[f"{side}_cam_{name}"], sections.get(f"{side}_disto"), there[name], pose))
        for side, pose in poses.items()
    )


def _pose(stereo: Entry, name: str) -> Pose:
    """Return the pose of the right camera: points are R X + t.

    Offsets may be stated for all resolutions at once.
    """
    offsets = [stereo[f"{key}_{name}", key].words().number() for key in ("ty", "tz")]
    t = stereo.at([-stereo["baseline"].words().number(), *offsets], "baseline, ty, tz")
    rotation = stereo.listed(*(f"{key}_{name}" for key in ("rx", "cv", "rz"))).words()
    return pose_of(rotation, t, metres=1e-3)


def _camera(fields: Entry, disto: Entry | None, hw: HW, pose: Pose) -> Camera:
    lens = disto if disto is not None and "k1" not in fields else fields
    fisheye = "k4" in lens and "p1" not in lens
    keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    if "k1" not in lens:
        raise fields.fail(
            "has no k1, and there is no LEFT_DISTO or RIGHT_DISTO with one: state the lens, 0 for none"
        )
    c = lens.at([lens.get(key, "0").words().number() for key in keys], ", ".join(keys))
    c = c if fisheye or any(c.value[5:]) else lens.at(c.value[:5], c.name)
    return Camera(
        K=fields.listed("fx", "fy", "cx", "cy").words().focal_and_centre(),
        cam_from_world=pose,
        hw=hw,
        distortion=c.kannala_brandt() if fisheye else c.brown_conrady(),
    )
