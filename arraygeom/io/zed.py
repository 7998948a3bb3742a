"""A ZED camera's factory calibration, `SN12345.conf`: an INI file with the pair at each resolution.

Source convention: as the maker's own rectification reads it (zed-open-capture, `calibration.hpp`), pixels
with the first centre at 0 (shift 0); OpenCV axes; lenses of OpenCV, in the camera's section or in
LEFT_DISTO and RIGHT_DISTO, fisheye ones where there is a k4 and no p1; RX, CV, RZ are the rotation vector
that takes points of the left camera into the right one. T = (-Baseline, TY, TZ), in millimetres, as its
calibration tool (zed-opencv-calibration) writes them. World = left camera; a file with left sections alone
is one camera, `left`.

Written by: Stereolabs' factory files and zed-opencv-calibration: 4K, QHDPLUS, 2K, FHD1200, FHD, HD, SVGA,
VGA; lenses in CAM or DISTO sections.
Refused: no coefficients at all.
Sample: hand-written: zed.conf, by the maker's [reader](https://github.com/stereolabs/zed-open-capture).
"""

from __future__ import annotations

import configparser

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


HEAD = r"(?i)\[LEFT_CAM_"


def read(source: RigSource) -> Rig:
    """Read the cameras `left` (the world) and `right` in metres, at the requested size, else at the largest.

    A file without a right camera gives `left` alone.

    Raises:
        RigFileError: for a damaged file, no left camera, no known size that both cameras have, none of the
            requested size, or missing numbers.
    """
    parser = configparser.ConfigParser(interpolation=None, inline_comment_prefixes=("#", ";"))
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
    if not there or "left" not in sides:
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
    offsets = [stereo[f"{key}_{name}", key].number() for key in ("ty", "tz")]
    t = stereo.at([-stereo["baseline"].number(), *offsets], "baseline, ty, tz")
    rotation = stereo.listed(*(f"{key}_{name}" for key in ("rx", "cv", "rz")))
    return pose_of(rotation, t, metres=1e-3)


def _camera(fields: Entry, disto: Entry | None, hw: HW, pose: Pose) -> Camera:
    lens = disto if disto is not None and "k1" not in fields else fields
    if "k1" not in lens:
        raise fields.fail(
            "has no k1, and there is no LEFT_DISTO or RIGHT_DISTO with one: state the lens, 0 for none"
        )
    return fields.camera(pose, hw=hw, distortion=lens.usual_lens())
