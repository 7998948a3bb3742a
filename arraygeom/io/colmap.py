"""COLMAP models, text and binary, with rigs (COLMAP 3.12 and later) or without.

Source convention: pixels with the first centre at 0.5 (shift -0.5); OpenCV axes; world->camera, quaternions
scalar first. The scale of a COLMAP model is arbitrary unless it was set; it is taken as metres.

Without rigs every *image* becomes a camera, named as the image is. Where the model has a rig of several
cameras, those become the cameras, named "camera1" after their ids (or the folder of their images), and the
world is the rig's frame.

Written by: COLMAP 3 and later, text and binary, with rigs (since 3.12) or without.
Refused: models beyond COLMAP's first eleven, RAD_TAN_THIN_PRISM_FISHEYE among them; several rigs.
Sample: real: Lund's door, of COLMAP's ground truth; [documented](https://colmap.github.io/format.html).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from ..camera import Camera, LensView
from ..checks import ROUNDED
from ..distortion import BROWN_CONRADY, KANNALA_BRANDT
from ..lenses.central import FOV, THIN_PRISM_FISHEYE
from ..pose import Pose
from ..rig import Rig
from .export import brown_conrady, calibrated, focal_and_centre
from .source import Entry, RigFileError, RigSource


class _Model(NamedTuple):
    """Layout of a camera model's parameters: focal lengths, then cx cy, then the lens.

    Attributes:
        id: number of the model in binary files.
        focals: number of focal lengths, 1 or 2.
        lens: name of our lens model; None for none.
        coefficients: number of its coefficients.
    """

    id: int
    focals: int
    lens: str | None
    coefficients: int


MODELS = {
    "SIMPLE_PINHOLE": _Model(0, 1, None, 0),
    "PINHOLE": _Model(1, 2, None, 0),
    "SIMPLE_RADIAL": _Model(2, 1, BROWN_CONRADY, 1),
    "RADIAL": _Model(3, 1, BROWN_CONRADY, 2),
    "OPENCV": _Model(4, 2, BROWN_CONRADY, 4),
    "OPENCV_FISHEYE": _Model(5, 2, KANNALA_BRANDT, 4),
    "FULL_OPENCV": _Model(6, 2, BROWN_CONRADY, 8),
    "FOV": _Model(7, 2, FOV, 1),
    "SIMPLE_RADIAL_FISHEYE": _Model(8, 1, KANNALA_BRANDT, 1),
    "RADIAL_FISHEYE": _Model(9, 1, KANNALA_BRANDT, 2),
    "THIN_PRISM_FISHEYE": _Model(10, 2, THIN_PRISM_FISHEYE, 8),
}


AT_ORIGIN = [1.0] + 6 * [0.0]
"""QW QX QY QZ TX TY TZ of a pose at the origin."""

Posed = tuple[Pose, int, str]
"""Pose of an image, or of a camera in its rig, with the camera's id and a name."""


def recognises(path: Path, head: str) -> bool:
    """Return True for a model's folder, one of its files, or a project folder."""
    return _folder(path) is not None


def read(source: RigSource) -> Rig:
    """Read the cameras of the model's rig of several, by folder or "camera1" ..., else each image's, by name.

    The path is that of the folder, a project's with `sparse` in it, or the model's file of cameras, images,
    rigs or frames. The scale is the model's, taken as metres; the world is the rig's frame, else the model's.

    Raises:
        RigFileError: for missing or damaged files, unknown models, equal names, several rigs of several
            cameras, or a camera without a place in its rig.
    """
    folder = _folder(source.path)
    if folder is None:
        raise source.fail(
            None, "is no COLMAP model: wanted a folder with cameras.txt and images.txt, or .bin"
        )
    suffix = ".bin" if (folder / "cameras.bin").exists() else ".txt"
    read_cameras, read_images, read_rigs = PARTS[suffix]
    cameras: dict[int, LensView] = {}
    for entry, i, model in read_cameras(_file(folder, "cameras", suffix)):
        if i in cameras:
            raise entry.source.fail(f"camera {i}", "occurs twice; keep one")
        cameras[i] = _intrinsics(entry, model)
    images = list(read_images(_file(folder, "images", suffix)))
    rigs = folder / f"rigs{suffix}"
    sensors = [s for s in (read_rigs(RigSource(rigs)) if rigs.exists() else []) if len(s) > 1]
    if len(sensors) > 1:
        raise RigSource(rigs).fail(None, f"has {len(sensors)} rigs of several cameras; keep one")
    named = [(pose, i, _sensor_name(i, images)) for pose, i, _ in sensors[0]] if sensors else images
    return source.rig((name, _camera(source, cameras, i, pose)) for pose, i, name in named)


def write(rig: Rig) -> dict[str, str]:
    """Format a text model: every camera of the rig as one camera and one image, no points.

    Depth range, links and sensors are left out.

    Returns:
        Texts of cameras.txt, points3D.txt and images.txt by file name.

    Raises:
        ValueError: for no cameras, uncalibrated ones, batches, names that are empty or have spaces at an end,
            and a K (skewed or mirrored, say) or lens that the format cannot hold.
    """
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    images = ["# IMAGE_ID, QW..QZ, TX..TZ, CAMERA_ID, NAME"]
    for i, (name, camera) in enumerate(calibrated(rig, "COLMAP"), 1):
        if name != name.strip() or len(name.splitlines()) != 1:
            raise ValueError(
                f"camera {name!r} has a name that is no text of one line, as COLMAP's files need: rename it"
            )
        h, w = camera.hw
        model, parameters = _parameters(name, camera)
        cameras.append(f"{i} {model} {w} {h} {_joined(parameters)}")
        q, t = camera.cam_from_world.quaternion, camera.t
        pose = [*(q if q[0] >= 0 else -q).tolist(), *t.tolist()]
        images += [f"{i} {_joined(pose)} {i} {name}", ""]
    points = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR"]
    texts = {"cameras.txt": cameras, "points3D.txt": points, "images.txt": images}
    return {name: "\n".join(lines) + "\n" for name, lines in texts.items()}


def _folder(path: Path) -> Path | None:
    """Return the model's folder, from itself, one of its files, or the project folder; None for none."""
    files = {
        f"{stem}{suffix}" for stem in ("cameras", "images", "rigs", "frames") for suffix in (".txt", ".bin")
    }
    if path.is_file():
        return path.parent if path.name in files else None
    for folder in (path, path / "sparse" / "0", path / "sparse"):
        if any((folder / f"cameras{suffix}").exists() for suffix in (".txt", ".bin")):
            return folder
    return None


def _file(folder: Path, stem: str, suffix: str) -> RigSource:
    source = RigSource(folder / f"{stem}{suffix}")
    if not source.path.exists():
        raise source.fail(None, "is missing; a COLMAP model has cameras and images, both .txt or both .bin")
    return source


def _camera(source: RigSource, cameras: dict[int, LensView], i: int, pose: Pose) -> Camera:
    if i not in cameras:
        raise source.fail(
            f"camera {i}", "is used by an image or a rig and not defined; do the files belong together?"
        )
    view = cameras[i]
    return Camera(K=view.K, cam_from_world=pose, hw=view.hw, distortion=view.distortion)


def _pose(entry: Entry) -> Pose:
    """Read a pose from QW QX QY QZ TX TY TZ."""
    numbers = entry.numbers((7,))
    q, t = numbers.split([4, 3])
    if not (q.norm() - 1).abs() < ROUNDED:
        raise entry.at(q, "QW QX QY QZ").fail(
            f"is a quaternion of length {q.norm():.4g}, not 1; is the order w x y z?"
        )
    return Pose.from_quaternion(q / q.norm(), t)


def _sensor(entry: Entry, camera: int, numbers: list[float] | None) -> Posed:
    if numbers is None:
        raise entry.fail(f"camera {camera} has no pose in its rig; calibrate the rig first")
    return _pose(Entry(entry.source, numbers, entry.name)), camera, ""


def _sensor_name(camera: int, images: list[Posed]) -> str:
    """Return the folder that all images of the camera are in, if they are in one; else a name from its id."""
    folders = {str(Path(name).parent) for _, i, name in images if i == camera}
    return folders.pop() if len(folders) == 1 and "." not in folders else f"camera{camera}"


def _intrinsics(entry: Entry, model: str) -> LensView:
    """Read a view from WIDTH HEIGHT PARAMS."""
    if model not in MODELS:
        raise entry.fail(f"has model {model}, which is not read: calibrate with one of {', '.join(MODELS)}")
    kind = MODELS[model]
    hw = entry.at(entry.value[:2], "WIDTH HEIGHT").size()
    p = entry.at(entry.value[2:], model).numbers((kind.focals + 2 + kind.coefficients,)).tolist()
    pinhole, c = [p[0], p[kind.focals - 1], *p[kind.focals : kind.focals + 2]], p[kind.focals + 2 :]
    return LensView(
        hw=hw,
        K=entry.at(pinhole, model).focal_and_centre(first_pixel=0.5),
        distortion=None
        if not kind.lens or (kind.lens == FOV and not any(c))
        else entry.at(c, model).lens(kind.lens),
    )


# The text files ---------------------------------------------------------------------------------------------


def _cameras_text(source: RigSource) -> Iterator[tuple[Entry, int, str]]:
    """Yield WIDTH HEIGHT PARAMS, the id and the model of every line CAMERA_ID MODEL WIDTH HEIGHT PARAMS."""
    for entry in _lines(source, "cameras"):
        fields = entry.value.split()
        if len(fields) < 5:
            raise entry.fail("wanted CAMERA_ID MODEL WIDTH HEIGHT PARAMS; is the file whole?")
        yield Entry(source, fields[2:], entry.name), _id(entry, fields[0]), fields[1]


def _images_text(source: RigSource) -> Iterator[Posed]:
    """Yield the images of every other line; those between hold the points, and may be blank."""
    for entry in _lines(source, "images", every=2):
        fields = entry.value.split(maxsplit=9)
        if len(fields) != 10:
            raise entry.fail("wanted IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; is the file whole?")
        pose = _pose(Entry(source, fields[1:8], entry.name))
        yield pose, _id(entry, fields[8]), fields[9].strip()


def _rigs_text(source: RigSource) -> list[list[Posed]]:
    rigs = [list(_sensors(entry)) for entry in _lines(source, "rigs")]
    if not rigs:
        raise source.fail(None, "holds no rig; was it cut off?")
    return rigs


def _sensors(entry: Entry) -> Iterator[Posed]:
    """Yield cameras of RIG_ID NUM_SENSORS REF_TYPE REF_ID, then TYPE ID HAS_POSE [QW QX QY QZ TX TY TZ] for
    the others."""
    tokens = iter(entry.value.split()[1:])
    try:
        for k in range(int(next(tokens))):
            kind, i = next(tokens), _id(entry, next(tokens))
            posed = k == 0 or next(tokens) == "1"
            words = [next(tokens) for _ in range(7)] if k and posed else AT_ORIGIN
            numbers = [float(word) for word in words] if posed else None
            if kind == "CAMERA":
                yield _sensor(entry, i, numbers)
    except RigFileError:
        raise
    except (StopIteration, ValueError, RuntimeError):
        raise entry.fail("is not a rig (RIG_ID NUM_SENSORS ...); is the file whole?") from None


def _lines(source: RigSource, what: str, every: int = 1) -> list[Entry]:
    """Return the lines that are no comments, nor blank (of an image's two the first); as many as stated."""
    lines = [(n, line) for n, line in enumerate(source.text().splitlines(), 1) if not line.startswith("#")]
    first = next((i for i, (_, line) in enumerate(lines) if line.strip()), 0)
    content = [source.at(line, f"line {n}") for n, line in lines[first::every] if line.strip()]
    for n, line in lines[first + 1 :: 2] if every == 2 else ():
        if len(line.split(maxsplit=10)) == 10:  # those of points have a multiple of three
            raise source.fail(f"line {n}", "wanted the points of the image above: add a line, blank if none")
    for line in source.text().splitlines()[:8]:
        head, _, rest = line.partition(f"Number of {what}:")
        stated = rest.split(",")[0].strip()
        if head.startswith("#") and stated.isdecimal() and int(stated) != len(content):
            raise source.fail(None, f"announces {stated} {what} and holds {len(content)}; was it cut off?")
    return content


def _id(entry: Entry, text: str) -> int:
    if not text.isdecimal():
        raise entry.fail(f"wanted a number as id, got '{text[:40]}'")
    return int(text)


# The binary files, little-endian ----------------------------------------------------------------------------


def _cameras_binary(source: RigSource) -> Iterator[tuple[Entry, int, str]]:
    names = {model.id: name for name, model in MODELS.items()}
    data = _Bytes(source)
    for _ in range(data.count()):
        i, model, w, h = data.take("<IiQQ")
        if model not in names:
            raise source.fail(f"camera {i}", f"has model number {model}, which is not supported")
        kind = MODELS[names[model]]
        parameters = data.take(f"<{kind.focals + 2 + kind.coefficients}d")
        yield source.at([w, h, *parameters], f"camera {i}"), i, names[model]


def _images_binary(source: RigSource) -> Iterator[Posed]:
    data = _Bytes(source)
    for _ in range(data.count()):
        i, *numbers, camera = data.take("<I7dI")
        name = data.string()
        data.take(f"{24 * data.count()}x")  # the points
        yield _pose(source.at(numbers, f"image {i}")), camera, name


def _rigs_binary(source: RigSource) -> list[list[Posed]]:
    """Read the cameras of each rig; other sensors are left out."""
    data, rigs = _Bytes(source), []
    for _ in range(data.count()):
        rig, count = data.take("<II")
        sensors = []
        for k in range(count):
            kind, i = data.take("<iI")
            posed = k == 0 or bool(data.take("<B")[0])
            numbers = list(data.take("<7d")) if k and posed else AT_ORIGIN
            if kind == 0:
                sensors.append(_sensor(source.at(None, f"rig {rig}"), i, numbers if posed else None))
        rigs.append(sensors)
    return rigs


PARTS: dict[str, tuple[Any, Any, Any]] = {
    ".txt": (_cameras_text, _images_text, _rigs_text),
    ".bin": (_cameras_binary, _images_binary, _rigs_binary),
}
"""Functions that read cameras, images and rigs, by the suffix of their files."""


class _Bytes:
    """A binary file read from front to back."""

    def __init__(self, source: RigSource) -> None:
        self.source, self.data, self.at = source, source.content(), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """Return the next values of a `struct` layout, and go past them.

        Raises:
            RigFileError: if the file ends before.
        """
        try:
            values = struct.unpack_from(layout, self.data, self.at)
        except struct.error:
            raise self.source.fail(f"byte {self.at}", "the file ends too early; was it cut off?") from None
        self.at += struct.calcsize(layout)
        return values

    def count(self) -> int:
        """Return the next count of entries (8 bytes), and go past it.

        Raises:
            RigFileError: if the file ends before, or has fewer bytes than that.
        """
        (n,) = self.take("<Q")
        if n > len(self.data):
            raise self.source.fail(
                f"byte {self.at}", f"counts {n} entries, more than fit; is this a COLMAP file?"
            )
        return int(n)

    def string(self) -> str:
        """Return the next zero-terminated text, and go past it; bytes that are no UTF-8 are replaced.

        Raises:
            RigFileError: if the file ends before.
        """
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self.source.fail(f"byte {self.at}", "the file ends within a name; was it cut off?")
        text, self.at = self.data[self.at : end].decode("utf-8", errors="replace"), end + 1
        return text


def _parameters(name: str, camera: Camera) -> tuple[str, list[float]]:
    lens, pinhole = camera.distortion, list(focal_and_centre(name, camera, first_pixel=0.5))
    if lens is None:
        return "PINHOLE", pinhole
    whole = {KANNALA_BRANDT: "OPENCV_FISHEYE", FOV: "FOV", THIN_PRISM_FISHEYE: "THIN_PRISM_FISHEYE"}
    if lens.model in whole:
        return whole[lens.model], pinhole + lens.coefficients.tolist()
    c = brown_conrady(name, lens, at_most=8)
    return ("OPENCV", pinhole + c) if len(c) == 4 else ("FULL_OPENCV", pinhole + c + [0.0] * (8 - len(c)))


def _joined(numbers: list[float]) -> str:
    return " ".join(map(repr, numbers))
