"""Rigs of two images alone, as `pat fuse a.png b.png` finds them, of pairs whose answer is known.

    python -m tests.benchmarks.bench_two_images --out tests/benchmarks/RESULTS_two_images.md

Fourteen pairs are drawn: photographs on planes, seen by pinhole cameras of 45 to 75 degrees with noise. Six
are real. *Answer*: `one homography` (nothing is said of lines and depth), or `lines`. The answer is right if
it is that of the scene, and if true points lie within a pixel (median) of the homography, or of the lines.
*Focal*: error of alpha's focal length, and how many of its stated deviations that is; empty if it is assumed.
*Depth*: median error of the depths of true points, after the best factor, where the rig has poses.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from arraygeom import Camera, Pose, Rig, apply_homography, intrinsics
from calib.images.depth_change import observed_depths
from calib.images.matches import Pairs, PointMatches, match_cameras
from calib.images.residuals import median_off
from pat.app.cli.parser import script
from pat.app.from_images import array_from_images
from pat.lab.evaluation.tables import markdown_header, markdown_row
from pat.media.images import read_image
from tests.benchmarks.printed import DATA, print_tables, reproducible
from tests.calib.real import every_pair

HW = (480, 640)
NOISE = 2.0
"""Standard deviation of the drawn images' noise, of 255."""
NEAR = 1.0
"""Largest median distance of true points from the homography or lines that are found, pixels."""
DEVIATIONS = 2.0
"""Largest error of a focal length, in stated deviations."""
REAL = (
    *("Bumblebee2 thing01", "KITTI 03/000000", "Middlebury 2006_third/Midd1", "Lund 1-3", "fox 0001-0009"),
)
FOUND = r"focal length (\d+) px \+- (\d+)%, by matched points"


class Layer(NamedTuple):
    """A plane with a photograph.

    Attributes:
        depth: depth of its middle, in baselines of the table's usual pair.
        tilt: rotation about the vertical and the horizontal, degrees.
        photo: number of the photograph.
        covered: share of it that is opaque, in blobs; 1 for all.
    """

    depth: float
    tilt: tuple[float, float] = (0.0, 0.0)
    photo: int = 0
    covered: float = 1.0


class Case(NamedTuple):
    """A drawn pair: planes, beta's rotation in degrees (x, y, z) and position, focal lengths in shares of the
    longer side; `lines` if its points show depth."""

    name: str
    layers: tuple[Layer, ...]
    turned: tuple[float, float, float] = (0.0, 0.0, 0.0)
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lines: bool = False
    focal: tuple[float, float] = (1.0, 1.0)


def room(*photos: int) -> tuple[Layer, ...]:
    """A wall, something before it, and something near, tilted."""
    a, b, c = photos
    return Layer(9.0, (10, 0), a), Layer(5.0, (-30, 10), b, 0.35), Layer(3.0, (25, -20), c, 0.2)


def skyline(*photos: int) -> tuple[Layer, ...]:
    a, b = photos
    return Layer(3000.0, photo=a), Layer(700.0, photo=b, covered=0.4)


CASES = (
    Case("wall", (Layer(4.0, (0, 0), 0),), (0, 4, 0), (1.0, 0, 0)),
    Case("wall, seen at 40 degrees", (Layer(4.0, (40, 0), 1),), (2, 8, 1), (0.8, 0.1, 0.3)),
    Case("ground from above, turned", (Layer(10.0, (5, 5), 2),), (1, 1, 30), (1.0, 0.5, 0)),
    Case("wall, other focal lengths", (Layer(4.0, (20, 10), 3),), (0, 5, 0), (1.0, 0, 0), focal=(0.7, 1.1)),
    Case("skyline", skyline(4, 5), (0, 0, 0), (0.3, 0, 0)),
    Case("skyline, turned", skyline(6, 7), (1, 6, 2), (0.2, 0.2, 0)),
    Case("skyline, wide and tele", skyline(8, 9), (0.5, 1, 0), (0.3, 0, 0), focal=(0.8, 1.6)),
    Case("turned at one place", room(10, 11, 12), (0, 8, 0)),
    Case("rolled at one place", room(13, 14, 0), (3, -5, 25)),
    Case("zoomed at one place", room(1, 2, 3), (0, 2, 0), focal=(0.8, 1.3)),
    Case("forward", room(4, 5, 6), (0, 0, 0), (0.05, 0, 1.0), lines=True),
    Case("forward, turned", room(7, 8, 9), (1, 3, 0), (0.2, 0.1, 1.0), lines=True, focal=(0.75, 0.75)),
    Case("sideways", room(10, 11, 12), (0, 0, 0), (0.6, 0, 0), lines=True),
    Case("around it", room(13, 14, 0), (4, 12, 5), (1.2, -0.4, 0.4), lines=True, focal=(0.75, 0.75)),
)


class Seen(NamedTuple):
    """A pair of images, the true rig (None if unknown), and points that truly match (alpha, beta)."""

    name: str
    images: dict[str, Tensor]
    rig: Rig | None
    points: PointMatches | None
    lines: bool


def drawn(case: Case, photos: Sequence[Path]) -> Seen:
    """Draw a case's images, each plane by its homographies, twice as fine and then reduced."""
    g = np.random.default_rng(CASES.index(case))
    R = Rotation.from_euler("xyz", case.turned, degrees=True).as_matrix()
    poses = Pose.identity(), Pose.from_centre(torch.from_numpy(R), torch.tensor(case.at).double())
    cameras = {
        name: Camera(K=intrinsics(share * max(HW), HW).double(), cam_from_world=pose, hw=HW)
        for name, share, pose in zip(("alpha", "beta"), case.focal, poses)
    }
    images = {name: np.full((2 * HW[0], 2 * HW[1]), 128.0) for name in cameras}
    grid = np.stack(np.meshgrid(np.arange(8, HW[1], 16), np.arange(8, HW[0], 16)), -1).reshape(-1, 2)
    matched = np.full((len(grid), 2), np.nan)
    for layer in case.layers:
        texture = cv2.imread(str(photos[layer.photo]), cv2.IMREAD_GRAYSCALE)
        texture = cv2.resize(texture, (1600, 1200), interpolation=cv2.INTER_AREA).astype(float)
        opaque = np.ones_like(texture)
        if layer.covered < 1:
            blobs = cv2.GaussianBlur(g.standard_normal(texture.shape), (0, 0), 90)
            opaque = (blobs > np.quantile(blobs, 1 - layer.covered)).astype(float)
        plane = _plane(layer, texture.shape, min(case.focal))
        maps = {}
        for name, camera in cameras.items():
            maps[name] = camera.K.numpy() @ np.c_[camera.R.numpy(), camera.t.numpy()] @ plane
            fine = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1]]) @ maps[name]
            size = images[name].shape[::-1]
            over = cv2.warpPerspective(opaque, fine, size)
            images[name] += over * (cv2.warpPerspective(texture, fine, size) - images[name])
        on_plane = _apply(np.linalg.inv(maps["alpha"]), grid)
        there = cv2.remap(opaque, *(on_plane[:, i].astype(np.float32) for i in (0, 1)), cv2.INTER_NEAREST)[
            :, 0
        ]
        matched = np.where(there[:, None] > 0.5, _apply(maps["beta"], on_plane), matched)
    inside = ((matched >= 0) & (matched <= np.array(HW[::-1]) - 1)).all(1)
    tensors = {}
    for name, image in images.items():
        image = cv2.resize(image, HW[::-1], interpolation=cv2.INTER_AREA) + g.normal(0, NOISE, HW)
        tensors[name] = torch.from_numpy(image.round().clip(0, 255) / 255)[None].float()
    points = PointMatches(*(torch.from_numpy(x[inside]).double() for x in (grid, matched)))
    return Seen(case.name, tensors, Rig(cameras), points, case.lines)


def _plane(layer: Layer, shape: tuple[int, ...], focal: float) -> np.ndarray:
    """World from a photograph's pixels (4, 3): it is 2.5 times as wide as what alpha sees there."""
    turned = Rotation.from_euler("yx", layer.tilt, degrees=True).as_matrix()
    h, w = shape
    pixel = 2.5 * layer.depth / focal / w
    middle = np.array([0, 0, layer.depth]) - turned[:, :2] @ np.array([w / 2, h / 2]) * pixel
    return np.r_[np.c_[turned[:, :2] * pixel, middle], [[0, 0, 1]]]


def _apply(H: np.ndarray, x: np.ndarray) -> np.ndarray:
    moved = np.c_[x, np.ones(len(x))] @ H.T
    return moved[:, :2] / moved[:, 2:]


def real(data: Path) -> Iterator[Seen]:
    """Pairs whose cameras are published, and a telephone's two cameras before a skyline."""
    for pair in every_pair(data):
        if pair.name in REAL:
            rig = Rig({name: pair.rig[name] for name in pair.images})
            (points,) = match_cameras(pair.images).values()
            yield Seen(pair.name, pair.images, rig, points, True)
    folder = data / "pairs" / "phone_wide_tele"
    images = {"wide": read_image(folder / "mono_wide.png"), "tele": read_image(folder / "tele.jpg")}
    yield Seen("telephone before a skyline", images, None, None, False)


def row(seen: Seen) -> tuple[str, bool]:
    """A line of the table, and True if the answer is right."""
    alpha, beta = seen.images
    array = array_from_images(seen.images, alpha=alpha)
    rig, matched = array.rig, {(alpha, beta): seen.points}
    lines = not any("one homography fits" in note for note in array.notes)
    right, off, focal, depth = lines == seen.lines, "", "", ""
    if seen.points is not None:
        median = _off(rig, matched, lines)
        off, right = f"{median:.2f}", right and median < NEAR
    if seen.rig is not None and (stated := re.search(FOUND, "\n".join(array.notes))):
        length, deviation = float(stated[1]), float(stated[2]) / 100
        error = length / float(seen.rig[alpha].K[0, 0]) - 1
        focal = f"{error:+.1%}, {abs(error) / deviation:.1f}"
        right = right and abs(error) <= DEVIATIONS * deviation
    if seen.rig is not None and lines and all(isinstance(rig[name], Camera) for name in rig.names):
        ratio = observed_depths(rig.replace(links={}), matched) / observed_depths(seen.rig, matched)
        ratio = ratio[~ratio.isnan()]
        depth = f"{float((ratio / ratio.median() - 1).abs().median()):.1%}" if len(ratio) else "none"
    answer = ["one homography", "lines"]
    cells = [seen.name, answer[seen.lines], answer[lines], off, focal, depth, "yes" if right else "**no**"]
    return markdown_row(cells), right


def _off(rig: Rig, matched: Pairs, lines: bool) -> float:
    """Median distance of points from their lines, or from where a homography puts them, pixels of beta."""
    if lines:
        return median_off(rig, matched)
    ((names, points),) = matched.items()
    moved = apply_homography(rig.pair(*names).homography.double(), points.alpha).x
    return float((moved - points.beta).norm(dim=-1).median())


def rows(data: Path) -> Iterator[str]:
    yield markdown_header(["pair", "scene", "answer", "off px", "focal", "depth", "right"])
    photos = sorted((data / "photos" / "city100").glob("*.jpg"))[::6]
    count = total = 0
    for seen in chain((drawn(case, photos) for case in CASES), real(data)):
        line, right = row(seen)
        count, total = count + right, total + 1
        yield line
    yield f"\nRight: {count} of {total}."


def main(data: Path = DATA, out: Path | None = None) -> None:
    """Print the table."""
    reproducible()
    print_tables("Rigs of two images alone", [rows(data)], out)


if __name__ == "__main__":
    script(main)
