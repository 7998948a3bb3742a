"""Focal lengths from two images alone, of pairs whose cameras are known, against the assumed ones.

    python -m tests.benchmarks.bench_focal --out tests/benchmarks/RESULTS_focal.md

Images with rectangular pixels are resized until those are square. *True*: of the longer side of the image.
*Assumed*, *fitted*: their errors. *Deviation*: of the fitted one, as stated; that of the prior is 50 %. It is
found if that is at most 25 %, if it is three of its deviations from the one assumed, and if held-out points
are nearer to their lines.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain, pairwise
from pathlib import Path

from torch.nn.functional import interpolate

from arraygeom import Camera
from arraygeom.io import read_rig
from calib.images.focal_length import fit_focal_length
from calib.images.from_images import rig_from_images
from calib.images.self_calibration import FOCAL_SHARE
from pat.app.cli.parser import script
from pat.app.from_images import matching_factor, resized_rig, scaled
from pat.lab.evaluation.tables import markdown_header, markdown_row
from tests.benchmarks.printed import DATA, print_tables, reproducible
from tests.calib.real import RealPair, ball, bumblebee, hilti, kitti, lund, middlebury, named, syntim

TUNE = ("SYNTIM Color", "SYNTIM Poly", "chess", "fox")
"""Parts of the names of the pairs on which the fit was made; settings are round numbers."""
SQUARE = 0.05


def pairs(data: Path) -> Iterator[RealPair]:
    """All of the known pairs, the telephone's frames one after the other."""
    yield from chain(*(source(data) for source in (syntim, bumblebee, kitti, middlebury, hilti, lund, ball)))
    folder = data / "rigs" / "nerf_fox"
    rig = read_rig(folder / "transforms.json")
    for a, b in pairwise(sorted((folder / "images").glob("*.jpg"))):
        yield named(f"fox {a.stem}-{b.stem}", rig, {f"images/{file.name}": file for file in (a, b)})


def with_square_pixels(pair: RealPair) -> RealPair:
    """The pair, its images resized along one side, both as alpha's pixels want it."""
    first, *_ = pair.images
    K = _camera(pair, first).K
    ratio = float(K[1, 1] / K[0, 0])
    if abs(ratio - 1) < SQUARE:
        return pair
    images = dict(pair.images)
    for name, image in images.items():
        h, w = image.shape[-2:]
        hw = (h, round(w * ratio)) if ratio > 1 else (round(h / ratio), w)
        images[name] = interpolate(image[None], size=hw, mode="bicubic", antialias=True)[0].clamp(0, 1)
    return RealPair(pair.name, resized_rig(pair.rig, images), images)


def row(pair: RealPair) -> list[str]:
    images = {name: scaled(image, matching_factor(image)) for name, image in pair.images.items()}
    pair = with_square_pixels(RealPair(pair.name, resized_rig(pair.rig, images), images))
    alpha, beta = pair.images
    true, longest = float(_camera(pair, alpha).K[0, 0]), max(pair.images[alpha].shape[-2:])
    half = "tune" if any(part in pair.name for part in TUNE) else "report"
    cells = [pair.name, half, f"{true / longest:.2f}", f"{FOCAL_SHARE * longest / true - 1:+.0%}"]
    try:
        found = rig_from_images(pair.images, alpha=alpha)
    except ValueError:
        return [*cells, "", "", "", "hardly any matches"]
    views, names = {name: found.rig[name] for name in (alpha, beta)}, (alpha, beta)
    fit = fit_focal_length(views, found.rig.links[names], found.matches[names])
    points = str(len(found.matches[names].alpha))
    if fit is None:
        return [*cells, points, "", "", "mirrored, or of unlike sizes"]
    figures = f"{fit.length / true - 1:+.0%}", f"{fit.deviation:.0%}", "found" if fit.found else ""
    return [*cells, points, *figures]


def _camera(pair: RealPair, name: str) -> Camera:
    camera = pair.rig[name]
    assert isinstance(camera, Camera)
    return camera


def rows(data: Path) -> Iterator[str]:
    yield markdown_header(["pair", "half", "true", "assumed", "points", "fitted", "deviation", ""])
    for pair in pairs(data):
        yield markdown_row(row(pair))


def main(data: Path = DATA, out: Path | None = None) -> None:
    """Print the table."""
    reproducible()
    print_tables("Focal lengths found from two images", [rows(data)], out)


if __name__ == "__main__":
    script(main)
