"""Values as recorded in image files, and the files of an alignment."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Literal, get_args
from xml.sax.saxutils import escape

import numpy as np
import tifffile
import torch
from numpy.typing import NDArray

from arraygeom.runtime.atomic import write_text
from arraygeom.runtime.together import refuse_others, write_together

from ..fusion.align import Aligned
from ..fusion.views import FilesOfCameras
from ..media.images import read_recorded, recorded_bands, write_image
from ..media.raw import demosaiced
from ..media.tags import RecordedTags, recorded_tags
from ..support.file_names import file_names
from .results import with_links

PositionFormat = Literal["npy", "tif", "none"]
GREY = np.array([0, 128, 255], np.float32) / 255
"""Grey levels of visibility in its image: beyond the edge, occluded, seen."""
GDAL_METADATA, GDAL_NODATA = 42112, 42113
"""TIFF tags in which GDAL, QGIS and others read the bands' names and wavelengths, and the value of pixels
without one (GDAL's documentation of GeoTIFF)."""
LARGEST_TIFF = 2**32 - 2**25
"""Bytes up to which a TIFF file has offsets of 32 bits; tifffile's own limit."""


class RecordedFiles(FilesOfCameras[NDArray[Any]]):
    """Values (C, H, W) of an image file of each camera as recorded, in its type, read when asked for.

    Made of a rig and an image file of each camera. With a colour filter pattern the first band is demosaiced
    to counts of red, green and blue, up to white. Three equal bands are one where the rig states one. Access
    raises as `read_recorded`, also for other sizes or cameras than the rig's; KeyError without a file.
    """

    def __getitem__(self, name: str) -> NDArray[Any]:
        view = self.rig[name]
        pattern = view.sensor.bayer
        turned: Literal["apply", "ignore"] = "apply" if pattern is None else "ignore"
        values = read_recorded(self.files[name], name=name, hw=view.hw, orientation=turned)
        values = recorded_bands(values, view.sensor)
        if pattern is None:
            return values
        counted = np.issubdtype(values.dtype, np.integer)
        white = 2 ** (view.sensor.bits or 8 * values.dtype.itemsize) - 1 if counted else 1
        colours = demosaiced(torch.from_numpy(values.astype(np.float32) / white), pattern).numpy()
        colours = colours.astype(np.float64) * white
        return (np.rint(colours) if counted else colours).astype(values.dtype)


def save_aligned(
    aligned: Aligned,
    out: Path,
    *,
    separate: bool = False,
    positions: PositionFormat = "npy",
    name: str = "",
    keep: Iterable[Path] = (),
    recorded: RecordedFiles | None = None,
    pages: Mapping[str, str] | None = None,
) -> list[Path]:
    """Write the files of an alignment to a folder.

    The files are aligned.tif (all bands, alpha's first, with their names and wavelengths), visibility.txt,
    and of each camera but alpha NAME_visibility.png (0 beyond its edge, 128 occluded, 255 seen),
    NAME_confidence.png and NAME_positions.npy (H, W, 2), or .tif of two bands: x, y; and depth.tif (rig's
    unit) if any depth is known. NAME is by `file_names`. All are swapped in together, and those of a former
    alignment of this name are removed (`write_together`).

    Args:
        aligned: the alignment.
        out: folder, made if missing.
        separate: True for one file a camera, NAME.tif, in place of aligned.tif, as also for values of
            different types.
        positions: format of the positions, "npy" or "tif"; "none" for no such files.
        name: prefix of the files, as in name_aligned.tif; empty for none.
        keep: files that must not be overwritten, such as the images.
        pages: further text files by name, without prefix; None for none.
        recorded: files from which the values were read: files of bands then have the tags of alpha's, by
            which mapping software places them, and the exposure, gain and black level that the rig states of
            each band. None for neither.

    Returns:
        Paths of the files, sorted.

    Raises:
        ValueError: for another format, two files of one name, and rather than overwrite a file of `keep`.
        FileExistsError: for files in the way that no run wrote.
        OSError: if files cannot be written; those of a former alignment stay.
    """
    if positions not in get_args(PositionFormat):
        raise ValueError(f"positions is {positions!r}: wanted {', '.join(get_args(PositionFormat))}")
    prefix = f"{name}_" if name else ""
    files = _files(aligned, separate, positions, recorded)
    files = [(f"{prefix}{file}", *how) for file, *how in files]
    named = [file for file, *_ in files]
    files += [(file, write_text, with_links(text, named)) for file, text in (pages or {}).items()]
    kept, count = {path.resolve() for path in keep}, Counter(file.casefold() for file, *_ in files)
    for file, *_ in files:
        if count[file.casefold()] > 1:
            raise ValueError(f"{out / file}: two results would have this name: rename the camera")
        if (out / file).resolve() in kept:
            raise ValueError(f"{out / file}: is one of the images: give another folder")
    with write_together(out, group=f"{prefix}aligned", last=f"{prefix}visibility.txt") as folder:
        for file, write, *parts in files:
            write(folder / file, *parts)
    return [out / file for file in sorted(file for file, *_ in files)]


def refuse_to_replace(out: Path, cameras: Iterable[str], *, separate: bool, name: str = "") -> None:
    """Raise FileExistsError if an alignment would replace files in `out` that no run wrote."""
    kinds = "_visibility.png", "_confidence.png", "_positions.npy", "_positions.tif", *[".tif"] * separate
    own = [f"{called}{kind}" for called in file_names(cameras).values() for kind in kinds]
    prefix = f"{name}_" if name else ""
    names = [f"{prefix}{file}" for file in ("aligned.tif", "depth.tif", "visibility.txt", *own)]
    refuse_others(out, [*names, *["index.html"] * (not name)], group=f"{prefix}aligned")


def _files(
    aligned: Aligned, separate: bool, positions: PositionFormat, recorded: RecordedFiles | None
) -> list[tuple[Any, ...]]:
    """List the name of each file of an alignment, the function that writes it, and its arguments."""
    called = file_names(aligned)
    tags = None if recorded is None else recorded_tags(Path(recorded.files[aligned.alpha]))
    facts = {name: [_of_sensor(recorded, name)] * len(view.bands) for name, view in aligned.items()}
    files: list[tuple[Any, ...]] = [("visibility.txt", write_text, _shares(aligned))]
    if np.isfinite(aligned.depth).any():
        write_depth = partial(write_image, bits=32, unknown=True)
        files.append(("depth.tif", write_depth, torch.from_numpy(aligned.depth)[None]))
    if separate or len({view.values.dtype for view in aligned.values()}) > 1:
        for camera, view in aligned.items():
            bands = view.bands, view.wavelengths, facts[camera], tags
            files.append((f"{called[camera]}.tif", write_bands, view.values, *bands))
    else:
        bands = aligned.bands, aligned.wavelengths, [*chain.from_iterable(facts.values())], tags
        files.append(("aligned.tif", write_bands, aligned.stack(), *bands))
    for camera, view in aligned.items():
        if camera != aligned.alpha:
            shown = {"visibility": GREY[view.visibility], "confidence": view.confidence}
            for kind, values in shown.items():
                files.append((f"{called[camera]}_{kind}.png", write_image, torch.from_numpy(values)[None]))
            file = f"{called[camera]}_positions.{positions}"
            if positions == "npy":
                files.append((file, np.save, view.positions))
            elif positions == "tif":
                planes = view.positions.transpose(2, 0, 1)
                files.append((file, write_bands, planes, ("x", "y"), (None, None)))
    return files


def _shares(aligned: Aligned) -> str:
    """Return a line for each camera but alpha with the share of alpha's pixels that it sees."""
    lines = []
    for camera, view in aligned.items():
        if camera != aligned.alpha:
            counts = np.bincount(view.visibility.ravel(), minlength=3)
            outside, occluded, visible = counts / view.visibility.size
            not_seen = f"{occluded:.1%} occluded or unmatched, {outside:.1%} beyond its edge"
            lines.append(f"{camera}: sees {visible:.1%} of {aligned.alpha}, {not_seen}\n")
    return "".join(lines)


def _of_sensor(recorded: RecordedFiles | None, name: str) -> dict[str, float]:
    """Return black level, exposure and gain of a camera, as far as its rig states them."""
    if recorded is None:
        return {}
    sensor = recorded.rig[name].sensor
    gain = sensor.gain if isinstance(sensor.gain, int | float) else None
    facts = {"BLACK_LEVEL": sensor.black_level, "EXPOSURE_SECONDS": sensor.exposure, "GAIN": gain}
    return {name: value for name, value in facts.items() if value}


def write_bands(
    path: Path,
    values: NDArray[Any],
    bands: Sequence[str],
    wavelengths: Sequence[float | None],
    facts: Sequence[Mapping[str, float]] = (),
    tags: RecordedTags | None = None,
) -> None:
    """Write bands (C, H, W) as one TIFF file in their type, with names and wavelengths (nanometres) for GIS.

    Args:
        path: file, replaced if there is one.
        values: values (C, H, W).
        bands: name of each of the C bands.
        wavelengths: central wavelength of each band, nanometres; None where unknown.
        facts: further numbers of each band by name, written as its metadata.
        tags: tags of the file whose pixels these are, written too; left out of files over `LARGEST_TIFF`.
            None for none.

    Raises:
        ValueError: for more names or wavelengths than bands, or fewer.
        OSError: if the file cannot be written; a part of it may be there.
    """
    if not len(bands) == len(wavelengths) == len(values):
        got = f"{len(bands)} names, {len(wavelengths)} wavelengths"
        raise ValueError(f"{path}: {len(values)} bands, {got}: give as many of each")
    items = [
        f'<Item name="{name}" sample="{i}">{value:.9g}</Item>'
        for i, of_band in enumerate(facts)
        for name, value in of_band.items()
    ]
    for i, (band, wave) in enumerate(zip(bands, wavelengths)):
        items.append(f'<Item name="DESCRIPTION" sample="{i}" role="description">{escape(band)}</Item>')
        if wave is not None:
            of = f'name="CENTRAL_WAVELENGTH_UM" domain="IMAGERY" sample="{i}"'
            items.append(f"<Item {of}>{wave / 1000:g}</Item>")
    described = f"<GDALMetadata>{''.join(items)}</GDALMetadata>"
    big = values.nbytes > LARGEST_TIFF
    tags = None if big else tags
    further = [] if tags is None else tags.extratags(bands, wavelengths)
    nothing = "nan" if np.issubdtype(values.dtype, np.floating) else "0"
    tifffile.imwrite(
        path,
        np.ascontiguousarray(values),
        photometric="minisblack",
        planarconfig="separate" if len(values) > 1 else None,
        bigtiff=big,
        byteorder="<",
        metadata=None,
        description=", ".join(bands).encode(),
        extratags=[
            *further,
            (GDAL_METADATA, "s", 0, described.encode(), True),
            (GDAL_NODATA, "s", 0, nothing, True),
        ],
    )
    if tags is not None:
        tags.write_directories(path)
