"""Files of a fusion."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from html import escape
from pathlib import Path
from typing import Literal
from urllib.parse import quote

import torch
from jaxtyping import Float
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from torch import Tensor

from arraygeom import Camera, Rig
from arraygeom.checks import check_above
from arraygeom.io.native import write as rig_text
from arraygeom.runtime.atomic import alone, write_text
from arraygeom.runtime.chunks import chunked
from arraygeom.runtime.text import ASSUMED
from arraygeom.runtime.threads import in_parallel
from arraygeom.runtime.together import LISTS, refuse_others, write_listed, write_together

from ..fusion.frame import Frame, picture_of
from ..media.colour import linear_from_srgb
from ..media.depth_maps import write_points
from ..media.figures import colour_depth
from ..media.images import write_image
from ..media.raw import developed
from ..support.file_names import file_names
from ..support.memory import how_many_fit

MOST = 65535
"""Largest count of 16 bits."""

ImageFormat = Literal["png", "tif", "exr"]

FOUND_RIG = "found_rig.yaml"
"""Name of the file of a rig estimated from images. Not rig.yaml, which may be a user's."""
LINKS = "<!-- files -->"
"""Place of the links to a run's files in its page."""
HEALED_RIG = "healed_rig.yaml"
"""Name of the file of a given rig as corrected to its images."""
RESULT = re.compile(
    r"(.*_)?((fused|confidence)(_.*)?|depth(_16|_nearest|_farthest)?)\.(png|tif|exr|mp4)"
    r"|(view|settings|found_rig|healed_rig)\.yaml|points\.ply|index\.html"
)
"""Pattern of the names of files that a fusion writes."""


def fused_group(name: str) -> str:
    """Return the group (`write_together`) of a frame's files."""
    return f"{name}_fused" if name else "fused"


def refuse_to_replace(out: Path, names: Iterable[str] = ("",)) -> None:
    """Raise FileExistsError if frames of these names would replace files in `out` that no run wrote."""
    names = {*names}
    found = [(path.name, match[1]) for path in _files(out) if (match := RESULT.fullmatch(path.name))]
    results = [file for file, prefix in found if (prefix or "").removesuffix("_") in names or not prefix]
    refuse_others(out, results, group=fused_group(""), by_name=names != {""})


def _files(out: Path) -> Iterable[Path]:
    return out.iterdir() if out.is_dir() else ()


def check_no_result(inputs: Iterable[Path], out: Path) -> None:
    """Raise ValueError for a file that has the name of a result and lies in the results' folder."""
    for path in inputs:
        if path.resolve().parent == out.resolve() and RESULT.fullmatch(path.name):
            raise ValueError(f"{path}: is called as a result, which would go there: give another folder")


def save_frame(
    frame: Frame,
    out: Path,
    *,
    bits: int = 8,
    kind: ImageFormat = "png",
    view: Rig | None = None,
    rig: Rig | None = None,
    points: Camera | None = None,
    along: Literal["depth", "distance"] = "depth",
    name: str = "",
    bands: Sequence[str] = (),
    pages: Mapping[str, str] | None = None,
    about: Mapping[str, str] | None = None,
) -> list[Path]:
    """Write the files of a frame to a folder.

    The files are fused.png, confidence.png, depth.tif (rig's unit, float; NaN where unknown), depth_16.png
    (`write_depth`), depth.png (red is near), depth_nearest.tif and depth_farthest.tif (the true depth is
    between in 9 of 10 pixels). Without any known depth there are no depth files, and no bounds of it for a
    view whose focal lengths are assumed. For other numbers of bands than one and three fused.png is the mean.
    All are swapped in together, the image last, and those of a former frame of this name are removed
    (`write_together`).

    Args:
        out: folder, made if missing.
        bits: 8 or 16 for sRGB values; 32 (tif, exr) for linear light as floats, not clipped.
        kind: format of the fused image.
        view: rig of alpha alone, written to view.yaml, which frames with a `name` share; None for none.
        rig: rig of all cameras, written to found_rig.yaml; None for no such file.
        points: camera of alpha; the pixels of known depth are written to points.ply. None for no such file.
        along: kind of depth (`measured_along`), for `points` and depth_16.png.
        name: prefix of the files, as in name_fused.png; empty for none.
        bands: a name for each band, where cameras record them one by one, each written to fused_NAME.png and
            (if the frame has `by_band`) confidence_NAME.png too, NAME by `file_names`; without names, bands
            that are not one or three are fused_1.png and so on.
        pages: further text files by name, without prefix; None for none.
        about: texts that `write_together` keeps about the group; None for none.

    Returns:
        Paths of the files, the image first; a shared view.yaml is not among them.

    Raises:
        ValueError: for bits that the format cannot hold, EXR without its extra, an image or confidence with
            NaN or infinity, and too few, too many or equal names of bands.
        FileExistsError: for files in the way that no fusion wrote.
        OSError: if files cannot be written. After any error those of a former frame stay.
    """
    frame = frame.mapped(lambda tensor: tensor.detach().cpu())
    prefix = f"{name}_" if name else ""
    last = f"{prefix}fused.{kind}"
    if view is not None and name:
        _write_shared(out / "view.yaml", rig_text(view))
    with write_together(out, group=fused_group(name), last=last, about=about) as folder:
        confidence = partial(write_image, folder / f"{prefix}confidence.png", frame.confidence[None])
        tasks: list[Callable[[], object]] = [confidence]
        if frame.depth.isfinite().any():
            known = view is None or view.name != ASSUMED
            bounds = zip(("_nearest", "_farthest"), frame.depth_interval) if known else ()
            for suffix, depth in (("", frame.depth), *bounds):
                path = folder / f"{prefix}depth{suffix}.tif"
                tasks.append(partial(write_image, path, depth[None], bits=32, unknown=True))
            near = float(view.depth[0]) if view is not None and view.depth else None
            path = folder / f"{prefix}depth_16.png"
            tasks.append(partial(write_depth, path, frame.depth, near=near, along=along))
            tasks.append(lambda: write_image(folder / f"{prefix}depth.png", colour_depth(frame.depth)))
        if view is not None and not name:
            view.save(folder / "view.yaml")
        if rig is not None:
            rig.save(folder / FOUND_RIG)
        if points is not None:
            write_points(folder / "points.ply", points, frame.depth, picture_of(frame.image), along=along)
        image = linear_from_srgb(frame.image) if bits == 32 else frame.image
        bands = bands or ([] if len(image) in (1, 3) else [str(i + 1) for i in range(len(image))])
        if bands and not len({*bands}) == len(bands) == len(image):
            raise ValueError(f"bands are {', '.join(bands)}: give a name of its own to each of {len(image)}")
        bands = list(file_names(bands).values())
        for band, values in zip(bands, image):
            write_image(folder / f"{prefix}fused_{band}.{kind}", values[None], bits=bits)
        for band, confidence in zip(bands, () if frame.by_band is None else frame.by_band):
            write_image(folder / f"{prefix}confidence_{band}.png", confidence[None].float())
        image = picture_of(image)
        tasks.insert(0, partial(write_image, folder / last, image, bits=bits, profile=bits != 32))
        in_parallel(tasks, most=how_many_fit(4 * image.nbytes))
        for file, text in (pages or {}).items():
            write_text(folder / file, with_links(text, (path.name for path in folder.iterdir())))
        names = {file.name for file in folder.iterdir()} - {last}
    return [out / last, *(out / file for file in sorted(names, key=lambda name: ("fused" not in name, name)))]


def with_links(page: str, names: Iterable[str]) -> str:
    """Return a page with links to files beside it, by name, where it has `<!-- files -->`."""
    links = ", ".join(f'<a href="{quote(name)}">{escape(name)}</a>' for name in sorted(names))
    return page.replace(LINKS, f"<section><h2>Files</h2><p>{links}</p></section>")


def _write_shared(path: Path, text: str) -> None:
    """Write a text that frames of a batch have in common, each in its own process."""
    (path.parent / LISTS).mkdir(parents=True, exist_ok=True)
    with alone(path.parent / LISTS / f"{path.name}.lock", 60):
        if not path.is_file() or path.read_bytes() != text.encode():
            write_listed(path, text)


def band_names(frame: Frame, betas: Iterable[str]) -> list[str]:
    """Return the cameras that record a frame's bands one by one, in order; empty unless they are several."""
    names = list(betas)
    return names if frame.by_band is not None and len(names) == len(frame.by_band) else []


def describe_bands(frame: Frame, names: Sequence[str], kind: ImageFormat) -> str:
    """Describe in a line which files hold the bands of a frame.

    Args:
        names: names of cameras that record the bands one by one; empty for none.
        kind: format of the files.

    Returns:
        The line; empty for one band or three without names.
    """
    if not names and len(frame.image) in (1, 3):
        return ""
    listed = (
        ", ".join(f"fused_{name}.{kind}" for name in file_names(names).values())
        or f"fused_1.{kind} and so on"
    )
    picture = "the three as a picture" if len(frame.image) == 3 else "their mean"
    return f"bands at alpha's view: {listed}; fused.{kind} is {picture}"


def depth_scale(near: float) -> float:
    """Return counts per metre of a 16-bit depth image: a power of ten that makes `near` at most MOST / 20.

    Raises:
        ValueError: for a `near` that is not above 0 and finite.
    """
    check_above(0, itself=False, near=near)
    return 10.0 ** math.floor(math.log10(MOST / 20 / near))


def write_depth(
    path: Path, depth: Float[Tensor, "h w"], *, near: float | None = None, along: str = "depth"
) -> float:
    """Write depth as a 16-bit PNG, in which 0 is unknown (not finite, or not above 0) and 65535 that or more.

    The file's text chunk "Description" has the scale, and says so if depth is measured along the ray.

    Args:
        depth: depth, metres or another unit of the rig's.
        near: depth by which the scale is chosen; None for the nearest in `depth`, or 1 for none.
        along: kind of depth (`measured_along`).

    Returns:
        The scale in counts per metre (or that unit): a power of ten.

    Raises:
        ValueError: as `depth_scale`.
        OSError: if the file cannot be written.
    """
    has_depth = depth.isfinite() & (depth > 0)
    nearest = float(depth[has_depth].min() if has_depth.any() else 1.0)
    scale = depth_scale(nearest if near is None else near)

    def counted(depth: Tensor, has_depth: Tensor) -> Tensor:
        return torch.where(has_depth, (depth.double() * scale).round().clamp(1, MOST), 0.0).to(torch.uint16)

    counts = chunked(counted, depth, has_depth).numpy()
    said = PngInfo()
    unit = "a metre, along the ray" if along == "distance" else "a metre"
    said.add_text("Description", f"depth: {scale:g} counts {unit}; 0 is unknown, {MOST} that far or farther")
    Image.fromarray(counts).save(path, format="PNG", pnginfo=said, compress_level=4)
    return scale


def view_of(rig: Rig, alpha: str, *, bits: int, bands: int = 3) -> Rig:
    """Return the rig of fused images: alpha's camera alone, with the coding that `save_frame` writes."""
    coding = "linear" if bits == 32 else "srgb"
    response = "rgb" if bands == 3 else rig[alpha].sensor.response
    sensor = dataclasses.replace(developed(rig[alpha].sensor), coding=coding, response=response)
    return Rig({alpha: rig[alpha].replace(sensor=sensor)}, depth=rig.depth, name=rig.name)
