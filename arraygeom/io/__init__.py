"""Rig files: one module a format, one registry.

Each reader's module states the convention of its format and the shift that it applies in its docstring, in a
paragraph that begins "Source convention:".
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path

import torch

from ..camera import Camera, LensView
from ..checks import check_above
from ..distortion import COEFFICIENT_COUNTS
from ..pixels import HW
from ..rig import Rig
from ..rig_check import file_oddities
from ..runtime.atomic import write_text
from ..runtime.extras import Registry, error_line
from ..runtime.together import sweep, write_together
from ..runtime.warned import warn
from ..sensor import Sensor
from . import kitti
from .export import at_origin, calibrated
from .source import RigFileError, RigFileWarning, RigSource, UnknownRigFormat, decoded

FORMATS = (
    *("colmap", "opencv", "kalibr", "boofcv", "ros", "native", "bouguet", "matlab", "kitti-raw", "kitti"),
    *("middlebury", "syntim", "nerfstudio", "strecha", "open3d"),
    *("metashape", "xmp", "luxonis", "mrcal", "lensboy", "realsense", "zed", "azure", "usual"),
)
"""Formats, each a module, in the order in which they are tried on a file."""
_READERS = {n: kitti.Raw if n == "kitti-raw" else import_module(f"{__name__}.{n}") for n in FORMATS}
_READERS |= dict.fromkeys(("aniposelib", "caliscope", "multical", "pycalib"), _READERS["usual"])
READERS = Registry("rig reader", ("read",), _READERS)
"""Readers of rig files by name of the format; yours are asked before the package's."""
ANY_SCALE = ("colmap", "nerfstudio", "usual", "strecha")
"""Formats that state no unit: their lengths are metres only if the file's author scaled them so."""
LIKELY = {
    r"Camera\d?\.fx|Camera\.type": "ORB-SLAM's settings, whose numbers are not read as a rig",
    r"T_cn_cnm1|cam_overlaps|rostopic": "Kalibr: wanted cam0, cam1, ... with intrinsics",
    r"(?i)opencv|FileStorage|camera_?matrix": "OpenCV: wanted !!opencv-matrix entries, as FileStorage has",
    r"(?i)distortion_model|camera_info|camera_model": "ROS or Kalibr: wanted camera_matrix, K, or cam0",
    r"(?i)<(calibration|photogroup|BlocksExchange|Cameras)\b": "Agisoft, ContextCapture or RealityCapture: "
    "export cameras as Agisoft XML with a chunk, or as COLMAP",
    r"(?i)\[(left|right|stereo)|\bbaseline\b": "a stereo camera's own settings",
    r"(?i)fisheye|distort|focal|intrinsic": "some tool for cameras",
}
"""Tools that probably wrote a file that no reader recognises, by words in it."""
_WRITERS = {name: READERS[name] for name in ("native", "opencv", "colmap", "kalibr", "nerfstudio")}
WRITERS = Registry("rig writer", ("write",), _WRITERS)
"""Writers of rig files: `write(rig)` returns the text of a file, or texts by name of a folder's files."""

__all__ = [
    "READERS",
    "WRITERS",
    "RigFileError",
    "RigFileWarning",
    "read_rig",
    "recognise",
    "write_rig",
]


def read_rig(
    path: str | Path,
    *,
    format: str | None = None,
    scale: float = 1.0,
    hw: HW | None = None,
    lens: str | None = None,
) -> Rig:
    """Read the rig of a file (or folder, for formats of several files).

    Suspicious but readable values, and entries that look like a lens, a flag or a unit and are not read, give
    a RigFileWarning.

    Args:
        format: name of a format in `READERS`; None to recognise it.
        scale: positive factor of all lengths, for files in another unit than their format's.
        hw: height and width of the images in pixels, for files that do not state them; None to guess them,
            with a warning.
        lens: model of the coefficients, for files that do not state it.

    Returns:
        The rig in double precision, with pixel centres at whole numbers and lengths in metres.

    Raises:
        RigFileError: for a file that is damaged, of no known format, or with numbers that no camera has; its
            text names the file and the entry.
        FileNotFoundError: for a missing file.
        ValueError: for an unknown format or lens model, and a scale that is not positive.
    """
    check_above(0, itself=False, scale=scale)
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such rig file: check the path")
    if not (path.is_file() or path.is_dir()):
        raise RigFileError(path, None, "is neither a file nor a folder")
    format = recognise(path) if format is None else format
    if format not in READERS:
        raise ValueError(f"unknown rig format '{format}' (known: {', '.join(READERS)})")
    if lens is not None and lens not in COEFFICIENT_COUNTS:
        raise ValueError(f"unknown lens model '{lens}' (known: {', '.join(COEFFICIENT_COUNTS)})")
    source = RigSource(path, hw=hw, lens=lens)
    try:
        rig = READERS[format].read(source)
        if not isinstance(rig, Rig):
            raise ValueError(f"read(source) returns a {type(rig).__name__}: wanted a Rig")
    except (RigFileError, FileNotFoundError, ImportError, MemoryError):
        raise
    except Exception as error:
        remedy = "is the file whole?" if format in _READERS else "is its reader right?"
        cause = f"cannot be read as {format} ({error_line(error)}); {remedy}"
        raise RigFileError(path, None, cause) from error
    source.warn_of_unread()
    lenses = [view.distortion for view in rig.cameras.values() if isinstance(view, LensView)]
    if lens is not None and not any(one is not None and one.model == lens for one in lenses):
        raise RigFileError(path, None, f"states its lenses itself, or none: {lens} has no use: leave it out")
    rig = rig if scale == 1.0 else rig.scaled(scale)
    _check_magnitudes(path, rig)
    for doubt in file_oddities(rig):
        source.warn(doubt)
    return rig


def write_rig(rig: Rig, path: str | Path, *, format: str = "native") -> None:
    """Write a rig to a file atomically.

    Formats of several files make a folder, the last of them after the others.

    What a format of the package leaves out of the rig is named by one RigFileWarning: all but the native one
    the depth range, links, what a sensor records; OpenCV's where the first camera is in the world.

    Args:
        format: "native", "opencv", "colmap", "kalibr", "nerfstudio" or another name in `WRITERS`.

    Raises:
        ValueError: for an unknown format, a rig that the format cannot hold, and a batch.
        FileExistsError: for a folder with files of these names that nothing here wrote.
        OSError: if it cannot be written.
    """
    if format not in WRITERS:
        raise ValueError(f"cannot write rig format '{format}' (known: {', '.join(WRITERS)})")
    path, contents = Path(path), WRITERS[format].write(rig)
    if not isinstance(contents, str | Mapping):
        raise ValueError(f"the writer of {format} gives a {type(contents).__name__}: wanted a text or texts")
    if format in {*_WRITERS} - {"native"} and (lost := _left_out(rig, format)):
        warn(f"{path}: {format} files do not hold the rig's {lost}: use the native format", RigFileWarning)
    if isinstance(contents, Mapping):
        sweep(path, format)
        with write_together(path, group=format, last=list(contents)[-1]) as folder:
            for name, text in contents.items():
                write_text(folder / name, text)
    else:
        write_text(path, contents)


def recognise(path: str | Path) -> str:
    """Return the name of a file's or folder's format.

    Raises:
        RigFileError: for an empty file, and a reader of yours that fails on it; its subclass UnknownRigFormat
            for one of no known format.
    """
    path = Path(path)
    head = decoded(path.read_bytes()[:4096]) if path.is_file() else ""
    if path.is_file() and not head.strip():
        raise RigFileError(path, None, "is empty")
    for name, reader in sorted(READERS.items(), key=lambda entry: entry[0] in _READERS):
        try:
            by_head = not hasattr(reader, "recognises")
            found = re.search(reader.HEAD, head) if by_head else reader.recognises(path, head)
        except Exception as error:
            cause = f"the reader of {name} cannot tell if it is one ({error_line(error)})"
            raise RigFileError(path, None, cause) from error
        if found:
            return name
    likely = next((f"It may be of {name}. " for word, name in LIKELY.items() if re.search(word, head)), "")
    raise UnknownRigFormat(
        path,
        None,
        f"is not a rig file of a known format. {likely}Write a rig file of its numbers: cameras: {{N: "
        "{size: [w, h], focal: px, centre: [x, y], rotation: 3x3, translation: [x y z], distortion: {model: "
        "brown-conrady, coefficients: [k1, k2, p1, p2]}}}; or name its format (`pat rig convert --read-as`)",
    )


def _left_out(rig: Rig, format: str) -> str:
    """Return what only the native format holds and this rig states, as words; empty for nothing."""
    kept = {"time_offset": 0.0} if format == "kalibr" else {}
    sensors = (dataclasses.replace(view.sensor, **kept) for view in rig.cameras.values())
    first = calibrated(rig, format)[0][1]
    stated = {
        "place in the world": format == "opencv" and not at_origin(first.cam_from_world),
        "depth range": rig.depth is not None,
        "links": bool(rig.links),
        "sensors": any(sensor != Sensor() for sensor in sensors),
    }
    return ", ".join(name for name, is_stated in stated.items() if is_stated)


SMALLEST_FOCAL, LARGEST_NUMBER = 1e-3, 1e9
"""Bounds of focal lengths (pixels), of all of K, and of translations (metres). Beyond them pixels lose their
digits."""


def _check_magnitudes(path: Path, rig: Rig) -> None:
    """Raise RigFileError for numbers that no camera has, whose squares or inverses are not numbers."""
    for name, view in rig.cameras.items():
        if isinstance(view, LensView):
            size = float(view.K.abs().max())
            if size > LARGEST_NUMBER or float(torch.linalg.svdvals(view.K[:2, :2]).min()) < SMALLEST_FOCAL:
                raise RigFileError(
                    path, name, f"has a K of numbers up to {size:g} or a focal length near 0: use pixels"
                )
        if isinstance(view, Camera) and float(view.t.abs().max()) > LARGEST_NUMBER:
            raise RigFileError(
                path, name, f"has a translation of {float(view.t.abs().max()):g} m: use metres"
            )
    if rig.depth is not None and float(rig.depth[0]) < 1 / LARGEST_NUMBER:
        raise RigFileError(path, "depth", f"begins at {float(rig.depth[0]):g} m: give a near bound in metres")
