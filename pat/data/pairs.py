"""Stereo pairs on disk, one at a time.

The readers are generators that hold one pair in memory at a time. A folder without any pair is an error. Left
is meant to be alpha, right beta: in a rectified pair the point at (x, y) in left is at (x - disparity, y) in
right.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pat.media.images import read_image


class Disparity(NamedTuple):
    """Disparity of left in pixels, >= 0, and where it is known."""

    value: Float[Tensor, "h w"]
    valid: Bool[Tensor, "h w"]


class StereoCalibration(NamedTuple):
    """Two pinhole cameras: X_right = R X_left + t, t in metres; the centre of the first pixel is (0, 0)."""

    K_left: Float[Tensor, "3 3"]
    K_right: Float[Tensor, "3 3"]
    R: Float[Tensor, "3 3"]
    t: Float[Tensor, " 3"]


@dataclass(frozen=True)
class StereoPair:
    """Two images, 0..1, grey or RGB, and what is known about them.

    `max_disparity` is in pixels of left, None for a pair that is not rectified.
    """

    name: str
    left: Float[Tensor, "c h w"]
    right: Float[Tensor, "cr hr wr"]
    max_disparity: float | None = None
    disparity: Disparity | None = None
    calibration: StereoCalibration | None = None


class PairFiles(NamedTuple):
    """Where a rectified pair is, and how far to look in it, in pixels of left."""

    left: Path
    right: Path
    max_disparity: float


class _Middlebury(NamedTuple):
    """How one Middlebury collection names its files, and the disparity value of one pixel."""

    left: str
    right: str
    ground_truth: str
    scale: int


MIDDLEBURY = {
    "2001": _Middlebury("scene1.row3.col3.ppm", "scene1.row3.col4.ppm", "truedisp.row3.col3.pgm", 16),
    "2003_quarter": _Middlebury("im2.png", "im6.png", "disp2.png", 4),
    "_half": _Middlebury("view1.png", "view5.png", "disp1.png", 2),
    "_third": _Middlebury("view1.png", "view5.png", "disp1.png", 3),
}
"""Layouts by a part of the collection's folder name."""

LEFT_AND_RIGHT = (
    ("_L.", "_R."),
    ("left.", "right."),
    ("left/", "right/"),
    ("image_2/", "image_3/"),
    ("colored_0/", "colored_1/"),
    ("view1.", "view5."),
    ("im2.", "im6."),
    ("im0.", "im1."),
)
"""What marks the left image's path, and what stands in its place in the right one's."""

PAPER_DISPARITY = 120.0
"""How far the paper looks in a rectified pair, in pixels of left; taken where a data set does not say."""

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".ppm", ".pgm"}


def middlebury_pairs(root: str | Path) -> Iterator[StereoPair]:
    """The 2001 to 2006 scenes under `root`/collection/scene with the true disparity of left.

    Collections are told apart by folder name: 2001..., 2003_quarter, ..._half, ..._third. The largest
    disparity is the one that the files can hold (255 / scale), not the scene's own. Tsukuba is its cameras 3
    and 4.
    """
    root = _folder(root)
    scenes = _middlebury_scenes(root)
    if not scenes:
        raise _no_pair(root)
    return (_middlebury_pair(root, left, layout) for left, layout in scenes)


def kitti_pairs(root: str | Path) -> Iterator[StereoPair]:
    """Colour KITTI pairs: image_2 / image_3, colored_0 / colored_1, or left.png / right.png.

    With a `calib.txt` beside the images or above them that has P2 and P3, the pair has its calibration.
    """
    return (_with_kitti_calibration(pair, file) for pair, file in _pairs_and_files(root))


def flickr_pairs(root: str | Path) -> Iterator[StereoPair]:
    """Flickr1024 pairs, 0001_L.png and 0001_R.png; near-rectified, without calibration."""
    return folder_pairs(root)


def folder_pairs(root: str | Path, *, max_disparity: float = PAPER_DISPARITY) -> Iterator[StereoPair]:
    """Every (near-)rectified pair under `root` whose names follow one of `LEFT_AND_RIGHT`."""
    return (pair for pair, _ in _pairs_and_files(root, max_disparity=max_disparity))


def pair_files(root: str | Path) -> list[PairFiles]:
    """The files of every pair that `middlebury_pairs` and `folder_pairs` read, in order, without reading them.

    Raises FileNotFoundError for no such folder, ValueError where there is no pair.
    """
    root = _folder(root)
    found = {left: PairFiles(left, right, PAPER_DISPARITY) for left, right in _named(root)}
    for left, layout in _middlebury_scenes(root):
        found[left] = PairFiles(left, left.with_name(layout.right), 255 / layout.scale)
    if not found:
        raise _no_pair(root)
    return [found[left] for left in sorted(found)]


def syntim_pairs(root: str | Path) -> Iterator[StereoPair]:
    """INRIA's SYNTIM pairs, unrectified, with their calibration; NAME0_*.png is left, NAME1_*.png right.

    Their files say x_cam = R^T (X - t) in millimetres; here cameras are relative to left, and in metres.
    """
    root = _folder(root)
    lefts = [file for file in sorted(root.glob("*0_O*.png")) if _syntim_right(file).is_file()]
    if not lefts:
        raise _no_pair(root)
    return (_syntim_pair(left) for left in lefts)


def _folder(root: str | Path) -> Path:
    root = Path(root)
    if not root.is_dir():
        raise FileNotFoundError(f"{root}: no such folder: check the path")
    return root


def _no_pair(root: Path) -> ValueError:
    return ValueError(f"{root}: holds no stereo pair: check the folder and how its images are named")


def _middlebury_scenes(root: Path) -> list[tuple[Path, _Middlebury]]:
    """Left images in folders of Middlebury's collections, in order."""
    return sorted(
        (file, layout)
        for key, layout in MIDDLEBURY.items()
        for file in root.rglob(layout.left)
        if any(key in folder for folder in file.parts[-3:-1])
    )


def _middlebury_pair(root: Path, left: Path, layout: _Middlebury) -> StereoPair:
    coded = read_image(left.with_name(layout.ground_truth))[0] * 255
    return StereoPair(
        left.parent.relative_to(root).as_posix(),
        read_image(left),
        read_image(left.with_name(layout.right)),
        max_disparity=255 / layout.scale,
        disparity=Disparity(coded / layout.scale, coded > 0),
    )


def _pairs_and_files(root: str | Path, *, max_disparity: float = PAPER_DISPARITY) -> Iterator[tuple[StereoPair, Path]]:
    root = _folder(root)
    files = _named(root)
    if not files:
        raise _no_pair(root)
    return ((_rectified_pair(root, left, right, max_disparity), left) for left, right in files)


def _named(root: Path) -> list[tuple[Path, Path]]:
    """Left and right by their names."""
    return [(left, right) for left in sorted(root.rglob("*")) for right in _right_of(left, root)]


def _rectified_pair(root: Path, left: Path, right: Path, max_disparity: float) -> StereoPair:
    return StereoPair(_pair_name(root, left), read_image(left), read_image(right), max_disparity)


def _right_of(left: Path, root: Path) -> list[Path]:
    """The right image of `left`, or nothing."""
    if left.suffix.lower() not in IMAGE_SUFFIXES:
        return []
    before, inside = root.as_posix(), left.as_posix()[len(root.as_posix()) :]
    rights = (Path(before + mark[1].join(inside.rsplit(mark[0], 1))) for mark in LEFT_AND_RIGHT if mark[0] in inside)
    return [right for right in rights if right.is_file()][:1]


def _pair_name(root: Path, left: Path) -> str:
    """What the path of `left` has besides the mark of left: `0001_L.png` is pair `0001`."""
    name = left.relative_to(root).with_suffix("").as_posix()
    return re.sub(r"(^|[/_])(L|left|image_2|colored_0|view1|im2|im0)($|/)", r"\3", name).strip("/") or name


def _with_kitti_calibration(pair: StereoPair, left: Path) -> StereoPair:
    candidates = (folder / "calib.txt" for folder in list(left.parents)[:2])
    file = next((candidate for candidate in candidates if candidate.is_file()), None)
    return replace(pair, calibration=_read_kitti(file)) if file else pair


def _read_kitti(file: Path) -> StereoCalibration | None:
    """Cameras 2 and 3 from their projections K [I | K^-1 p]: rectified, they share their rotation."""
    rows = dict(line.split(":", 1) for line in file.read_text().splitlines() if ":" in line)
    if not {"P2", "P3"} <= rows.keys():
        return None
    left, right = (torch.tensor([float(x) for x in rows[key].split()]).reshape(3, 4) for key in ("P2", "P3"))
    centre = torch.linalg.solve(right[:, :3], right[:, 3]) - torch.linalg.solve(left[:, :3], left[:, 3])
    return StereoCalibration(left[:, :3], right[:, :3], torch.eye(3), centre)


def _syntim_right(left: Path) -> Path:
    return left.with_name(re.sub(r"0_(O\w+\.png)$", r"1_\1", left.name))


def _syntim_pair(left: Path) -> StereoPair:
    scene = left.name.rsplit("0_", 1)[0]
    cameras = (_read_syntim(left.with_name(f"cam_{scene}_{side}")) for side in "gd")
    (K_left, R_left, t_left), (K_right, R_right, t_right) = cameras
    R = R_right @ R_left.mT
    calibration = StereoCalibration(K_left, K_right, R, t_right - R @ t_left)
    images = read_image(left), read_image(_syntim_right(left))
    return StereoPair(left.stem.replace("0_", "_"), *images, calibration=calibration)


def _read_syntim(file: Path) -> tuple[Tensor, Tensor, Tensor]:
    """K, R and t of X_cam = R X_world + t in metres, from a file of x_cam = R^T (X - t) in millimetres."""
    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such calibration: it should be beside the images")
    text = file.read_text()
    values = [float(x) for x in re.findall(r"[-+]?\d+\.\d+(?:[eE][-+]?\d+)?", text)]
    if len(values) != 17:
        raise ValueError(f"{file}: has {len(values)} decimal numbers, wanted 17: u0, v0, au, av, focal, R, t")
    u0, v0, au, av, _ = values[:5]
    K = torch.tensor([[au, 0, u0], [0, av, v0], [0, 0, 1]])
    R = torch.tensor(values[5:14]).reshape(3, 3).mT.contiguous()
    return K, R, -R @ torch.tensor(values[14:]) / 1000
