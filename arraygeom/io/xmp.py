"""Tags of the images of one capture: Pix4D's `Camera:` (MicaSense, Parrot Sequoia, senseFly), `drone-dji`.

A file is one image; the others of its capture are those beside it whose names differ in what follows the
last "_".

Source convention: principal points in millimetres (pixels where the units say so) from the image's first
pixel, whose centre is 0 (shift 0), as in MicaSense's own code; focal lengths in millimetres or, above 100
or where the units say so, in pixels; radial R1 R2 R3 and tangential T1 T2 as OpenCV's k1 k2 k3 p1 p2.
Fisheye: theta = 2 / pi times the angle off axis goes to p0 + p1 theta + p2 theta^2 + ..., which the matrix
C D E F takes to pixels. `RigRelatives` are degrees about x, y and z, R = Rx Ry Rz: camera->rig, inverted;
`RigTranslations` are the cameras' centres, metres. DJI's `DewarpData` is fx fy cx cy k1 k2 p1 p2 k3, with
cx and cy counted from `CalibratedOpticalCenter`, for images whose `DewarpFlag` is not 1. All are of the
pixels as stored: the rig is of the images as their orientation tags say.

Written by: tags in images of MicaSense, Parrot Sequoia, senseFly (Pix4D's `Camera:`) and of DJI;
`DewarpFlag`, `BlackCurrent`, `SensorGain`, bands.
Refused: images of several captures; mirrored images; vignetting and `CalibratedHMatrix` are left out.
Sample: real: a Sequoia's capture, two of a RedEdge.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..camera import Camera
from ..distortion import Distortion
from ..lenses import PolynomialFisheye
from ..lenses.model import LensModel
from ..pixels import HW
from ..pose import Pose, rotation_from_vector
from ..rig import Rig
from ..runtime.extras import needs
from ..sensor import Band, Sensor
from .source import Entry, RigSource

PIX4D, DJI, MICASENSE = "pix4d.com", "drone-dji", "micasense.com/MicaSense"
"""Parts of the names of XMP's namespaces; those of Pix4D's `Camera:` differ between makers."""
RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
EXIF, GPS = 0x8769, 0x8825
"""Tags of TIFF's directories with EXIF's fields (2.32)."""
LARGEST_XMP = 1 << 20
"""Largest size of an XMP packet, bytes: those of cameras have some tens of thousands."""
PHOTOGRAPHS = (".jpg", ".jpeg")
SUFFIXES = (".tif", ".tiff", *PHOTOGRAPHS)
USUAL_WIDTH = 20.0
"""Width in nanometres of a band for which none is stated."""
IN_PIXELS = 100.0
"""Focal length above which it is in pixels: no lens of these has so many millimetres, no image so
few pixels."""
LONGEST_TRANSLATION = 1.0
"""Largest distance in metres between cameras of one body; a longer one is in another unit."""
BLACK_LEVEL, EXPOSURE, ISO, ISO_SPEED, TAKEN, SERIAL = 50714, 0x829A, 0x8827, 0x8833, 0x9003, 0xA431
NORTH, LATITUDE, EAST, LONGITUDE = 1, 2, 3, 4
"""GPS tags: the hemispheres' letters, and degrees, minutes and seconds."""
SAME_PLACE = 1e-3
"""Degrees of latitude or longitude, some 100 m, by which images of one capture may differ:
receivers drift."""
RESOLUTION_X, RESOLUTION_Y, RESOLUTION_UNIT = 0xA20E, 0xA20F, 0xA210
ORIENTATION, QUARTER_TURNS = 274, {1: 0, 3: 2, 6: 3, 8: 1}
"""EXIF's tag of the orientation, and the quarter turns counter-clockwise that turn each upright."""
MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
"""Millimetres in EXIF's units of resolution: inch, cm, mm, micrometre."""


def recognises(path: Path, head: str) -> bool:
    """Return True for a TIFF or JPEG image whose tags state its camera."""
    return path.suffix.lower() in SUFFIXES and path.is_file() and _states_camera(image_tags(path))


def read(source: RigSource) -> Rig:
    """Read the rig of the capture that an image belongs to, its cameras named by their bands.

    Raises:
        RigFileError: as `rig_of_images`.
    """
    return rig_of_images(named_by_band(capture_of(source.path)))


def capture_of(path: Path) -> list[Path]:
    """List the images of the capture that an image belongs to.

    They are TIFF and JPEG files of one folder whose names, without suffix, differ only after the last "_".

    Returns:
        Files, sorted; those whose tags state no camera are left out, `path` too. For a name without "_"
        `path` alone, whatever its tags.

    Raises:
        OSError: for a file or folder that cannot be opened.
        ImportError: without Pillow.
    """
    stem = path.stem.rpartition("_")[0]
    beside = sorted(
        p for p in path.parent.iterdir() if p.suffix.lower() in SUFFIXES and p.stem.rpartition("_")[0] == stem
    )
    return [p for p in beside if _states_camera(image_tags(p))] if stem else [path]


def named_by_band(paths: Sequence[Path]) -> dict[str, Path]:
    """Name images by their bands, as their tags state them.

    Returns:
        Files by name: the band's, in lower case, "rgb" for three bands. If a tag is missing or two are equal,
        all are named by the end of the file's name after the last "_", else by the whole name, else
        "camera1", "camera2", ...

    Raises:
        OSError: for a file that cannot be opened.
        ImportError: without Pillow.
    """
    bands = []
    for path in paths:
        tags = image_tags(path)
        words = tags.xmp.get("BandName", "").split(",") if tags else []
        name = "rgb" if len(words) == 3 else words[0] if len(words) == 1 else ""
        bands.append(re.sub(r"[^\w.-]+", "_", name.lower()))
    ends = [path.stem.rpartition("_")[2] for path in paths]
    for names in (bands, ends, [path.stem for path in paths]):
        if all(names) and len(set(names)) == len(names):
            return dict(zip(names, paths))
    return {f"camera{i}": path for i, path in enumerate(paths, 1)}


def states_cameras(paths: Sequence[Path]) -> bool:
    """Return True if the tags of every image state its camera; False for no images."""
    return bool(paths) and all(recognises(path, "") for path in paths)


def rig_of_images(files: Mapping[str, Path]) -> Rig:
    """Read the rig of one capture's images from their tags.

    A camera without distortion has no lens, one without rotation has the rig's axes, one without translation
    is at its origin. Warnings name all but the first without rotation, and say if all of several are there.

    Args:
        files: image of each camera by name.

    Returns:
        The rig, of the images as their orientation tags rotate them; lengths in metres.

    Raises:
        RigFileError: for images without tags, tags that lack intrinsics or are damaged, several captures or
            bodies, and mirrored or cropped images.
        OSError: for a file that cannot be opened.
        ValueError: for no images, and numbers that no camera or sensor has.
        ImportError: without Pillow.
    """
    if not files:
        raise ValueError("there are no images")
    first = RigSource(next(iter(files.values())))
    images = {name: _Image.from_source(first.beside(path)) for name, path in files.items()}
    _check_one_capture(images)
    cameras = [(name, image.camera()) for name, image in images.items()]
    rig = first.rig(cameras)
    if unrotated := [name for name, image in images.items() if image.rotation is None][1:]:
        first.warn(f"RigRelatives are not stated of {', '.join(unrotated)}: parallel axes are assumed")
    if [image.text(key) for image in images.values() for key in image.tags.xmp if "Vignetting" in key]:
        first.warn("vignetting is stated, and not applied: values are as recorded")
    first.warn_of_unread()
    if len(cameras) > 1 and not any(bool(image.centre.any()) for image in images.values()):
        first.warn(
            "RigTranslations are not stated: all cameras are at one point; state the translations, in metres"
        )
    return rig


class _Image(NamedTuple):
    """One image's tags with their source."""

    source: RigSource
    tags: ImageTags
    stated: Entry

    @classmethod
    def from_source(cls, source: RigSource) -> _Image:
        """Read the tags of an image, with their source.

        Raises:
            RigFileError: unless they state its camera.
            OSError: for a file that cannot be opened.
            ImportError: without Pillow.
        """
        tags = image_tags(source.path)
        if tags is None or not _states_camera(tags):
            raise source.fail(None, "has no tags of a camera (Camera: or drone-dji): give a rig file instead")
        return cls(source, tags, source.at(tags.xmp))

    def text(self, name: str) -> str | None:
        """Return an XMP tag; None if it is not stated."""
        value: str | None = self.stated.get(name).value
        return value

    def numbers(self, name: str, *count: int) -> Tensor | None:
        """Return the numbers of a tag, as many as `count` states; None if it is not stated."""
        text = self.text(name)
        return (
            None if text is None else self.stated.at(re.sub("[,;]", " ", text), name).numbers(count or None)
        )

    def needed(self, name: str, count: int) -> Tensor:
        """Return the numbers of one of Pix4D's tags.

        Returns:
            Vector of `count` numbers, float64.

        Raises:
            RigFileError: if it is not stated, has another count, or is no finite numbers.
        """
        numbers = self.numbers(name, count)
        if numbers is None:
            raise self.source.fail(name, "is not stated: give a rig file instead")
        return numbers

    @property
    def per_mm(self) -> Tensor:
        """Pixels per millimetre of the sensor, (x, y), float64, by EXIF's focal-plane resolution (per inch
        unless stated).

        Raises:
            RigFileError: if it is not stated.
        """
        fields = self.tags.fields
        if RESOLUTION_X not in fields:
            raise self.source.fail(
                "FocalPlaneXResolution",
                "is not stated, and the camera's numbers are in millimetres: give a rig file",
            )
        unit = MILLIMETRES.get(int(fields.get(RESOLUTION_UNIT, (2,))[0]), 25.4)
        x = float(fields[RESOLUTION_X][0])
        return torch.tensor([x, float(fields.get(RESOLUTION_Y, (x,))[0])], dtype=torch.float64) / unit

    @property
    def rotation(self) -> Tensor | None:
        """Rotation from the camera to the rig; None if it is not stated."""
        if (degrees := self.numbers("RigRelatives", 3)) is None:
            return None
        about_x, about_y, about_z = rotation_from_vector(torch.deg2rad(degrees).diag())
        return about_x @ about_y @ about_z

    @property
    def centre(self) -> Tensor:
        """Camera's centre (3) in the rig, metres, float64; zero if it is not stated.

        Raises:
            RigFileError: for other than three numbers, and numbers too large for metres.
        """
        if (translation := self.numbers("RigTranslations", 3)) is None:
            return torch.zeros(3, dtype=torch.float64)
        if float(translation.abs().max()) > LONGEST_TRANSLATION:
            raise self.source.fail(
                "RigTranslations",
                f"is {translation.tolist()}, and metres are wanted: give a rig file in metres",
            )
        return translation

    def camera(self) -> Camera:
        """Return the camera with its pose in the rig."""
        K, lens = self._dji() if self.text("ModelType") is None else self._pix4d()
        K, rotation = self._checked(K), self.rotation
        R = torch.eye(3, dtype=torch.float64) if rotation is None else rotation.mT
        pose = Pose(R, -R @ self.centre)
        camera = Camera(K=K, cam_from_world=pose, hw=self.tags.hw, distortion=lens, sensor=self.sensor())
        return camera.rot90(self._quarter_turns())

    def _quarter_turns(self) -> int:
        """Return the turns by which a viewer, and `pat`, rotate the stored pixels, which the tags are of."""
        orientation = int(self.tags.fields.get(ORIENTATION, (1,))[0])
        if orientation not in QUARTER_TURNS:
            raise self.source.fail(
                "Orientation", f"is {orientation}, a mirrored image: save it as the camera did"
            )
        return QUARTER_TURNS[orientation]

    def _pix4d(self) -> tuple[Tensor, LensModel | None]:
        """Return K and the lens by Pix4D's tags; lengths are in millimetres or pixels."""
        kind, centre = self.text("ModelType"), self.needed("PrincipalPoint", 2)
        if "pixel" not in (self.text("PrincipalPointUnits") or "mm"):
            centre = centre * self.per_mm
        K = torch.eye(3, dtype=torch.float64)
        K[:2, 2] = centre
        if kind == "perspective":
            (focal,) = self.needed("PerspectiveFocalLength", 1)
            units = self.text("PerspectiveFocalLengthUnits") or ("pixel" if focal > IN_PIXELS else "mm")
            K[:2, :2] = torch.diag(focal.expand(2) if "pixel" in units else focal * self.per_mm)
            if (c := self.numbers("PerspectiveDistortion", 5)) is None:
                return K, None
            r1, r2, r3, t1, t2 = c
            lens = self.source.at([r1, r2, t1, t2, r3], "PerspectiveDistortion").brown_conrady()
            return K, lens
        if kind != "fisheye":
            raise self.source.fail("ModelType", f"is '{kind}'; perspective and fisheye are read")
        p = self.numbers("FisheyePolynomial")
        if p is None or not 2 <= len(p) <= 5 or float(p[0]) != 0 or float(p[1]) <= 0:
            raise self.source.fail(
                "FisheyePolynomial", "is not 0, a positive number and up to three more: is it whole?"
            )
        scale = 2 / math.pi
        K[:2, :2] = self.needed("FisheyeAffineMatrix", 4).reshape(2, 2) * float(p[1]) * scale
        bends = p[2:] / p[1] * scale ** torch.arange(1, len(p) - 1, dtype=torch.float64)
        return K, PolynomialFisheye(bends)

    def _dji(self) -> tuple[Tensor, Distortion | None]:
        """Return K and the lens by DJI's DewarpData: fx, fy, cx, cy from the middle, k1, k2, p1, p2, k3."""
        (h, w), text = self.tags.hw, self.text("DewarpData") or ""
        dated, _, numbers = text.rpartition(";")
        if not dated:
            raise self.source.fail("DewarpData", "is not a date and nine numbers: give a rig file instead")
        listed = self.source.at(numbers.replace(",", " "), "DewarpData")
        fx, fy, cx, cy, *c = listed.numbers((9,)).tolist()
        x, y = (self._one(f"CalibratedOpticalCenter{axis}", n / 2) for axis, n in (("X", w), ("Y", h)))
        K = torch.tensor([[fx, 0, x + cx], [0, fy, y + cy], [0, 0, 1]], dtype=torch.float64)
        flag = self.numbers("DewarpFlag", 1)
        if flag is None:
            self.source.warn("DewarpFlag is not stated: taken as not dewarped, with the lens of DewarpData")
        return K, None if flag is not None and flag.any() else self.source.at(c, "DewarpData").brown_conrady()

    def _checked(self, K: Tensor) -> Tensor:
        """Return an intrinsic matrix after checking that its principal point is near the image's middle."""
        K = self.source.at(K, "PrincipalPoint").intrinsics()
        (h, w), (x, y) = self.tags.hw, K[:2, 2].tolist()
        if not (0.25 * w < x < 0.75 * w and 0.25 * h < y < 0.75 * h):
            raise self.source.fail(
                "PrincipalPoint", f"is at {x:.0f}, {y:.0f} of an image of {w}x{h}: was it cropped or resized?"
            )
        return K

    def sensor(self) -> Sensor:
        """Return the sensor by the tags.

        Returns:
            Its response: "rgb", a Band (20 nm wide if unstated), or None if unstated. Of raw bands (no
            colour, no JPEG) also linear coding, 16 bits, black level (0 if unstated), exposure (or None), and
            gain (ISO / 100, SensorGain, or 1). What is assumed gives a warning.

        Raises:
            RigFileError: for tags that are no numbers.
            ValueError: also as `Sensor` and `Band` raise it.
        """
        fields = self.tags.fields
        colour = len((self.text("BandName") or "").split(",")) == 3
        centre, width = (self._one(name, 0.0) for name in ("CentralWavelength", "WavelengthFWHM"))
        if centre and not width and not colour:
            self.source.warn(f"WavelengthFWHM is not stated: a band {USUAL_WIDTH:g} nm wide is assumed")
        response = "rgb" if colour else Band(centre, width or USUAL_WIDTH) if centre else None
        black = fields.get(BLACK_LEVEL, self.numbers("BlackCurrent"))
        if colour or self.source.path.suffix.lower() in PHOTOGRAPHS:  # developed: sRGB, no counts of light
            return Sensor(response=response)
        stated = fields.get(ISO, fields.get(ISO_SPEED))
        gain = self.numbers("SensorGain", 1)
        speed = float(stated[0]) if stated else 100.0 if gain is None else 100.0 * float(gain)
        missing = {"black level": black is None, "gain (ISO speed)": stated is None and gain is None}
        if any(missing.values()):
            names = " and no ".join(name for name, is_missing in missing.items() if is_missing)
            self.source.warn(
                f"states no {names}: taken as {'0' if black is None else '1'}; a rig file may state it"
            )
        levels = [0.0] if black is None else [float(value) for value in black]
        exposure = float(fields.get(EXPOSURE, (0.0,))[0]) or None
        return Sensor(
            response=response,
            coding="linear",
            bits=16,
            black_level=sum(levels) / len(levels),
            exposure=exposure,
            gain=float(speed) / 100.0,
        )

    def _one(self, name: str, otherwise: float) -> float:
        numbers = self.numbers(name)
        return otherwise if numbers is None or not len(numbers) else float(numbers[0])


def _states_camera(tags: ImageTags | None) -> bool:
    return tags is not None and bool(tags.xmp.keys() & {"ModelType", "DewarpData"})


def _check_one_capture(images: Mapping[str, _Image]) -> None:
    """Raise RigFileError for images of several captures or of several bodies."""
    kinds = {
        "capture": lambda tags: tags.xmp.get("CaptureUUID") or tags.xmp.get("CaptureId"),
        "serial number": lambda tags: tags.fields.get(SERIAL, (None,))[0],
        "time": lambda tags: tags.fields.get(TAKEN, (None,))[0],
    }
    (name, first), *others = images.items()
    for _, image in others:
        for kind, stated in kinds.items():
            one, two = stated(first.tags), stated(image.tags)
            if one and two and one != two:
                raise image.source.fail(
                    None,
                    f"is of another {kind} than the image of '{name}' ({two}, {one}): "
                    "give images of one capture",
                )
        place, other = _place(first.tags), _place(image.tags)
        if place and other and math.dist(place, other) > SAME_PLACE:
            here, there = (f"{north:.4f}, {east:.4f}" for north, east in (other, place))
            raise image.source.fail(
                None,
                f"is of another place by GPS than the image of '{name}' ({here}; "
                f"{there}): give images of one capture",
            )


def _place(tags: ImageTags) -> tuple[float, float] | None:
    """Return latitude and longitude, degrees; None if they are not stated."""
    degrees = []
    for letter, number in ((NORTH, LATITUDE), (EAST, LONGITUDE)):
        parts = tags.fields.get(number, ())
        if len(parts) != 3:
            return None
        value = sum(float(component) / 60**i for i, component in enumerate(parts))
        degrees.append(-value if tags.fields.get(letter, ("",))[0] in ("S", "W") else value)
    return degrees[0], degrees[1]


# Tags of a file --------------------------------------------------------------------------------------------


class ImageTags(NamedTuple):
    """Tags of an image file.

    Attributes:
        hw: height and width of the stored pixels, before an orientation is applied.
        fields: values of TIFF, EXIF and GPS fields by their number, as tuples; 0 for NaN.
        xmp: XMP tags by name (lists joined by commas), of the first of Pix4D's, DJI's and MicaSense's
            namespaces that has it.
    """

    hw: HW
    fields: dict[int, tuple[Any, ...]]
    xmp: dict[str, str]


def image_tags(path: Path) -> ImageTags | None:
    """Read the tags of a TIFF or JPEG file.

    Returns:
        The tags; None for other files, damaged ones, and those without XMP of `ImageTags`' namespaces.

    Raises:
        OSError: for a file that cannot be opened.
        ImportError: without Pillow, for a file with XMP.
    """
    xmp = _xmp(path.read_bytes())
    if not xmp:
        return None
    with needs("calibration", "reading images' tags"):
        from PIL import Image
    try:
        with Image.open(path, formats=("TIFF", "JPEG")) as image:
            exif = image.getexif()
            stated = dict(exif) | exif.get_ifd(EXIF) | exif.get_ifd(GPS)
            values = {tag: v if isinstance(v, tuple) else (v,) for tag, v in stated.items()}
            # 0 / 0 is NaN, by which cameras say that they do not know
            fields = {tag: tuple(0.0 if v != v else v for v in each) for tag, each in values.items()}
            return ImageTags((image.height, image.width), fields, xmp)
    except Exception:  # whatever Pillow trips over in a damaged file
        return None


def xmp_packet(content: bytes) -> bytes:
    """Return the XMP packet in a file's bytes; empty if there is none that can be read safely."""
    begin = content.find(b"<x:xmpmeta")
    end = content.find(b"</x:xmpmeta>", begin)
    if begin < 0 or not 0 < end - begin < LARGEST_XMP:
        return b""
    packet = content[begin : end + len(b"</x:xmpmeta>")]
    return b"" if b"<!DOCTYPE" in packet or b"<!ENTITY" in packet else packet


def _xmp(content: bytes) -> dict[str, str]:
    """XMP tags of the namespaces above; empty if there are none, or the packet is damaged."""
    try:
        root = ET.fromstring(xmp_packet(content))
    except ET.ParseError:
        return {}
    tags: dict[str, dict[str, str]] = {MICASENSE: {}, DJI: {}, PIX4D: {}}
    for described in root.iter(f"{RDF}Description"):
        parts = [(key, value) for key, value in described.attrib.items()]
        parts += [
            (child.tag, ",".join(text for raw in child.itertext() if (text := raw.strip())))
            for child in described
        ]
        for key, value in parts:
            uri, _, name = key.removeprefix("{").partition("}")
            for namespace in tags:
                if namespace in uri and name:
                    tags[namespace][name] = value.strip()
    return tags[MICASENSE] | tags[DJI] | tags[PIX4D]
