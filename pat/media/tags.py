"""Tags of image files on where, when and by which camera they were taken."""

from __future__ import annotations

import math
import re
import struct
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from PIL import ExifTags, Image, TiffImagePlugin

from arraygeom.io.xmp import DJI, MICASENSE, PIX4D, RDF, xmp_packet
from arraygeom.pixels import HW
from arraygeom.runtime.image_bytes import DAMAGED

EXIF, GPS = int(ExifTags.IFD.Exif), int(ExifTags.IFD.GPSInfo)
KEPT = {
    EXIF: (
        *(0x829A, 0x829D, 0x8827, 0x8833, 0x9000, 0x9003, 0x9004, 0x9202, 0x920A, 0xA20E, 0xA20F, 0xA210),
        *(0xA405, 0xA431, 0xA432, 0xA433, 0xA434),
    ),
    GPS: tuple(range(32)),
}
"""Exposure, aperture, sensitivity, times, focal length, resolution of the sensor, serial number, lens."""
TEXTS = {271: "Make", 272: "Model", 306: "DateTime"}
XMP, LONG, ENTRY = 700, 4, 12
"""The tag of a packet, TIFF's number of a type, and the bytes of an entry."""
LISTED = "BandName", "CentralWavelength"
OF_ONE = re.compile(
    r"BandName|CentralWavelength|WavelengthFWHM|Rig.*|.*(Vignetting|Irradiance|Sensitivity|HMatrix).*"
)
"""XMP tags of one band of a camera, and its place among the others."""


class RecordedTags(NamedTuple):
    """Tags of an image file that results keep.

    Attributes:
        texts: make, model and time, by the number of the tag (`TEXTS`); only those that the file has.
        directories: tags of EXIF and GPS as Pillow reads them, by the directory's number (`EXIF`, `GPS`) and
            the tag's (`KEPT`); an empty directory is left out.
        xmp: the XMP packet; empty without.
    """

    texts: dict[int, str]
    directories: dict[int, dict[int, Any]]
    xmp: bytes

    def extratags(self, bands: Sequence[str], wavelengths: Sequence[float | None]) -> list[tuple[Any, ...]]:
        """List entries for tifffile, which writes all but directories."""
        tags: list[tuple[Any, ...]] = [(tag, "s", 0, text, True) for tag, text in self.texts.items()]
        packet = packet_of_bands(self.xmp, bands, wavelengths) if self.xmp else b""
        return [*tags, (XMP, "B", len(packet), packet, True)] if packet else tags

    def write_directories(self, path: Path) -> None:
        """Add the directories of EXIF and GPS to a TIFF file's first image; the file is rewritten in place.

        The file must be little-endian with offsets of 32 bits, as tifffile writes it, and have no such
        directories yet; this is not checked. OSError if it is missing or cannot be written.
        """
        content = bytearray(path.read_bytes())
        first = int.from_bytes(content[4:8], "little")
        end = first + 2 + ENTRY * int.from_bytes(content[first : first + 2], "little")
        entries = [bytes(content[i : i + ENTRY]) for i in range(first + 2, end, ENTRY)]
        for tag, values in self.directories.items():
            directory = TiffImagePlugin.ImageFileDirectory_v2(group=tag)
            for number, value in values.items():
                directory[number] = TiffImagePlugin.IFDRational(value) if isinstance(value, float) else value
            content += b"\0" * (-len(content) % 4)
            entries.append(struct.pack("<HHII", tag, LONG, 1, len(content)))
            content += directory.tobytes(len(content))
        content += b"\0" * (-len(content) % 4)
        content[4:8] = struct.pack("<I", len(content))
        following = bytes(content[end : end + 4])
        ordered = sorted(entries, key=lambda entry: int.from_bytes(entry[:2], "little"))
        path.write_bytes(content + struct.pack("<H", len(ordered)) + b"".join(ordered) + following)


def recorded_tags(path: Path) -> RecordedTags | None:
    """Read the tags of an image file that results keep: make, model, time, EXIF, GPS and XMP.

    Returns:
        The tags; None if it has none of these, or Pillow cannot read it: damaged, missing, of another format,
        or beyond Pillow's limit of pixels.
    """
    try:
        with Image.open(path) as image:
            exif = image.getexif()
            directories = {
                tag: {number: value for number, value in exif.get_ifd(tag).items() if number in kept}
                for tag, kept in KEPT.items()
            }
            texts = {tag: str(exif[tag]) for tag in TEXTS if tag in exif}
    except Exception:  # whatever Pillow trips over in a damaged file
        return None
    tags = RecordedTags(texts, {tag: d for tag, d in directories.items() if d}, xmp_packet(path.read_bytes()))
    return tags if any(tags) else None


def packet_of_bands(packet: bytes, bands: Sequence[str], wavelengths: Sequence[float | None]) -> bytes:
    """Adjust one camera's XMP packet for an image of several bands at that camera's pixels.

    Tags of its own band and of its place in the rig are left out (vignetting, radiometry); the camera, its
    pose and its flight stay. Bands and wavelengths replace Pix4D's tags of them; a packet without such tags
    gets none.

    Args:
        packet: XMP packet of the camera's file.
        bands: names of the bands.
        wavelengths: their central wavelengths in nanometres; none are written if one is None.

    Returns:
        The packet; empty for an empty or damaged one.
    """
    for prefix, uri in re.findall(r'xmlns:(\w+)="([^"]+)"', packet.decode(errors="replace")):
        if not re.fullmatch(r"ns\d+", prefix):
            ET.register_namespace(prefix, uri)
    try:
        root = ET.fromstring(packet)
    except ET.ParseError:
        return b""
    listed = dict(zip(LISTED, (bands, [] if None in wavelengths else [f"{w:g}" for w in wavelengths])))
    for described in root.iter(f"{RDF}Description"):
        for key in dict.fromkeys([*described.attrib, *(child.tag for child in described)]):
            uri, _, name = key.removeprefix("{").partition("}")
            maker = next((maker for maker in (PIX4D, DJI, MICASENSE) if maker in uri), None)
            of_one = maker == MICASENSE and name != "CaptureId"
            if not (of_one or OF_ONE.fullmatch(name) or "DLS" in uri):
                continue
            described.attrib.pop(key, None)
            for child in described.findall(key):
                described.remove(child)
            if values := listed.get(name) if maker == PIX4D else None:
                sequence = ET.SubElement(ET.SubElement(described, key), f"{RDF}Seq")
                for value in values:
                    ET.SubElement(sequence, f"{RDF}li").text = value
    return ET.tostring(root)


_FOCAL, _FOCAL_35MM, _WIDTH, _HEIGHT = 0x920A, 0xA405, 0xA002, 0xA003
_PLANE_RESOLUTION, _PLANE_UNIT = 0xA20E, 0xA210
_DIAGONAL_35MM = 43.267
"""Diagonal of 36 x 24 mm, in mm."""
_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
"""Millimetres of the EXIF units of a sensor's resolution: inch, cm, mm, micrometre."""


def focal_length(path: str | Path, hw: HW) -> float | None:
    """Read a photograph's focal length from its EXIF tags.

    Args:
        hw: size of the image that the focal length is wanted for: the whole picture, at any scale; at the
            file's own where the tags state the sensor's resolution without the picture's size.

    Returns:
        Focal length in pixels of that image, from the sensor's resolution or else the 35 mm equivalent; None
        if the tags do not state it, or the file is missing or cannot be read by Pillow.
    """
    try:
        with Image.open(path) as image:
            tags = image.getexif().get_ifd(EXIF)
        focal, resolution = (_number(tags.get(tag)) for tag in (_FOCAL, _PLANE_RESOLUTION))
        unit = _MM.get(int(_number(tags.get(_PLANE_UNIT)) or 2))
        if focal and resolution and unit:
            longer = max(_number(tags.get(tag)) or 0.0 for tag in (_WIDTH, _HEIGHT)) or max(hw)
            return focal * resolution / unit * max(hw) / longer
        film = _number(tags.get(_FOCAL_35MM))
        return film * math.hypot(*hw) / _DIAGONAL_35MM if film else None
    except (*DAMAGED, Image.DecompressionBombError):
        return None


def _number(value: object) -> float | None:
    number = float(value) if value is not None else 0.0  # type: ignore[arg-type]
    return number if math.isfinite(number) and number > 0 else None
