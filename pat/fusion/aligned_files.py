"""Values as recorded from image files, and what an alignment leaves on disk."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal
from xml.sax.saxutils import escape

import numpy as np
import tifffile
import torch
from numpy.typing import NDArray

from arraygeom.runtime.atomic import write_together

from ..media.images import read_recorded, write_image
from ..media.raw import demosaiced, recorded_bands
from .align import Aligned, AlignedView
from .views import FilesOfCameras

PositionFormat = Literal["npy", "tif", "none"]
GREY = np.array([0, 128, 255], np.float32) / 255
"""Of visibility in its image: beyond the edge, occluded, seen."""
GDAL_METADATA, GDAL_NODATA = 42112, 42113
"""TIFF tags in which GDAL, QGIS and others read the bands' names and wavelengths, and the value of pixels
without one (GDAL's documentation of GeoTIFF)."""
LARGEST_TIFF = 2**32 - 2**25
"""Bytes up to which a TIFF file has offsets of 32 bits; tifffile's own limit."""


class RecordedFiles(FilesOfCameras[NDArray[Any]]):
    """The values of an image file of each camera, read when asked for: counts, linear of raw ones.

    Those behind a colour filter pattern are demosaiced: red, green and blue counts. Asking raises as
    `read_recorded`.
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
) -> list[Path]:
    """Write aligned.tif (all bands, alpha's first, with their names and wavelengths), and of each camera
    NAME_visibility.png (0 beyond its edge, 128 occluded, 255 seen), NAME_confidence.png and
    NAME_positions.npy (or .tif: x, y); depth.tif (metres) if any is known.

    One file a camera, NAME.tif, if `separate`, or if their types differ: values keep theirs. With a `name`
    the files are name_aligned.tif and so on. All are written, or none. Of a former alignment bands, depth,
    positions and the page index.html are gone; files of a camera that nothing replaces stay, as they may be
    its images. Returns what was written.

    Raises ValueError for a camera with a file of its own that is called "depth", and rather than write over a
    file of `keep`, such as the images.
    """
    prefix = f"{name}_" if name else ""
    unlike = len({view.values.dtype for view in aligned.values()}) > 1
    if (separate or unlike) and "depth" in aligned:
        raise ValueError(
            "the camera 'depth' would have its values in depth.tif, where the depth goes: rename the camera"
        )
    stale = {f"{prefix}aligned.tif", f"{prefix}depth.tif"} | (set() if name else {"index.html"})
    stale |= {f"{prefix}{camera}_positions.{kind}" for camera in aligned for kind in ("npy", "tif")}
    kept = {path.resolve() for path in keep}
    stale = {file for file in stale if (out / file).resolve() not in kept}
    with write_together(out, last=f"{prefix}visibility.txt", stale=stale) as folder:
        if separate or unlike:
            for camera, view in aligned.items():
                write_bands(folder / f"{prefix}{camera}.tif", view.values, view.bands, view.wavelengths)
        else:
            write_bands(folder / f"{prefix}aligned.tif", aligned.stack(), aligned.bands, aligned.wavelengths)
        if np.isfinite(aligned.depth).any():
            depth = torch.from_numpy(aligned.depth)[None]
            write_image(folder / f"{prefix}depth.tif", depth, bits=32, unknown=True)
        for camera, view in aligned.items():
            if camera != aligned.alpha:
                _write_view(folder, f"{prefix}{camera}", view, positions)
        (folder / f"{prefix}visibility.txt").write_text(_shares(aligned), encoding="utf-8")
        names = sorted(file.name for file in folder.iterdir())
        if over := [out / file for file in names if (out / file).resolve() in kept]:
            raise ValueError(f"{over[0]}: is one of the images: give another --out")
    return [out / file for file in names]


def _write_view(folder: Path, stem: str, view: AlignedView, positions: PositionFormat) -> None:
    write_image(folder / f"{stem}_visibility.png", torch.from_numpy(GREY[view.visibility])[None])
    write_image(folder / f"{stem}_confidence.png", torch.from_numpy(view.confidence)[None])
    if positions == "npy":
        np.save(folder / f"{stem}_positions.npy", view.positions)
    elif positions == "tif":
        planes = view.positions.transpose(2, 0, 1)
        write_bands(folder / f"{stem}_positions.tif", planes, ("x", "y"), (None, None))


def _shares(aligned: Aligned) -> str:
    """A line for each camera but alpha: what share of alpha's pixels it sees."""
    lines = []
    for camera, view in aligned.items():
        if camera != aligned.alpha:
            outside, occluded, visible = (
                np.bincount(view.visibility.ravel(), minlength=3) / view.visibility.size
            )
            not_seen = f"{occluded:.1%} occluded or unmatched, {outside:.1%} beyond its edge"
            lines.append(f"{camera}: sees {visible:.1%} of {aligned.alpha}, {not_seen}\n")
    return "".join(lines)


def write_bands(
    path: Path, values: NDArray[Any], bands: Sequence[str], wavelengths: Sequence[float | None]
) -> None:
    """Write bands (C, H, W) as one TIFF in their type, with names and wavelengths (nanometres) for GIS."""
    items = []
    for i, (band, wave) in enumerate(zip(bands, wavelengths, strict=True)):
        items.append(f'<Item name="DESCRIPTION" sample="{i}" role="description">{escape(band)}</Item>')
        if wave is not None:
            of = f'name="CENTRAL_WAVELENGTH_UM" domain="IMAGERY" sample="{i}"'
            items.append(f"<Item {of}>{wave / 1000:g}</Item>")
    described = f"<GDALMetadata>{''.join(items)}</GDALMetadata>"
    nothing = "nan" if np.issubdtype(values.dtype, np.floating) else "0"
    tifffile.imwrite(
        path,
        np.ascontiguousarray(values),
        photometric="minisblack",
        planarconfig="separate" if len(values) > 1 else None,
        bigtiff=values.nbytes > LARGEST_TIFF,
        metadata=None,
        description=", ".join(bands).encode(),
        extratags=[(GDAL_METADATA, "s", 0, described.encode(), True), (GDAL_NODATA, "s", 0, nothing, True)],
    )
