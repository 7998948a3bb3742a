"""Stereo pairs on disk, read one at a time.

In a rectified pair the point at (x, y) in left is at (x - disparity, y) in right.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pat.media.images import read_image
from pat.support.folders import files_below

T = TypeVar("T")


class Disparity(NamedTuple):
    """True disparity of the left image.

    Attributes:
        value: disparity in pixels of left, 0 or more; meaningless where not `valid`.
        valid: True where the disparity is known.
    """

    value: Float[Tensor, "h w"]
    valid: Bool[Tensor, "h w"]

    def regions(self) -> DisparityRegions:
        """Classify the left image's pixels by whether right sees their point.

        A pixel is occluded if another of its row falls on the same pixel of right (positions are rounded)
        with a disparity greater by more than 1.

        Returns:
            Masks (h, w): seen, occluded, beyond right's left edge; all False where the disparity is unknown.
        """
        column = (torch.arange(self.value.shape[1]).to(self.value) - self.value).round()
        on_right = self.valid & (column >= 0)
        index = torch.where(on_right, column, 0).long()
        disparity = torch.where(on_right, self.value, 0)
        front = torch.zeros_like(disparity).scatter_reduce(1, index, disparity, "amax")
        hidden = front.gather(1, index) > self.value + 1
        return DisparityRegions(on_right & ~hidden, on_right & hidden, self.valid & ~on_right)


class DisparityRegions(NamedTuple):
    """Masks of the left image's pixels of known disparity; they exclude each other.

    Attributes:
        seen: visible in right.
        occluded: behind another surface in right.
        beyond: left of right's left edge.
    """

    seen: Bool[Tensor, "h w"]
    occluded: Bool[Tensor, "h w"]
    beyond: Bool[Tensor, "h w"]


@dataclass(frozen=True)
class StereoPair:
    """Two images and their known disparities.

    Attributes:
        name: name in tables, usually the path.
        left: image 0..1, grey (one channel) or RGB.
        right: image 0..1, grey or RGB; its size is not checked.
        max_disparity: largest disparity in pixels of left; None if unknown.
        disparity: true disparity of left; None if unknown.
    """

    name: str
    left: Float[Tensor, "c h w"]
    right: Float[Tensor, "cr hr wr"]
    max_disparity: float | None = None
    disparity: Disparity | None = None


class PairFiles(NamedTuple):
    """Files of a rectified pair.

    Attributes:
        left: left image.
        right: right image.
        max_disparity: for Middlebury's the largest disparity that the file can hold, pixels of left; for
            others `PAPER_DISPARITY`.
        ground_truth: file of left's true disparity, 8 bits, 0 where unknown; None unless Middlebury's.
        scale: counts of that file for a pixel of disparity.
    """

    left: Path
    right: Path
    max_disparity: float
    ground_truth: Path | None = None
    scale: int = 1


class _Middlebury(NamedTuple):
    """File names of one Middlebury collection, and its disparity value for one pixel."""

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
"""Marks of left and right images in their paths."""

PAPER_DISPARITY = 120.0
"""Largest disparity in the paper, pixels of left; used where a data set states none."""

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".ppm", ".pgm"}


def middlebury_pairs(root: str | Path) -> Iterator[StereoPair]:
    """Read the 2001 to 2006 scenes under `root`/collection/scene, with left's true disparity.

    Collections are recognised by 2001, 2003_quarter, _half or _third in the name of the folder of the images
    or the one above it. Tsukuba is its cameras 3 and 4.

    Returns:
        Pairs, read one at a time, named by their folder's path below `root`; `max_disparity` is what the
        files can hold (255 / scale), not the scene's own.

    Raises:
        FileNotFoundError: for a missing folder, right image or disparity.
        ValueError: for a folder without a pair; while pairs are read, for an image that cannot be.
    """
    root = _folder(root)
    return (_read(root, files) for files in _some(_middlebury(root, "right", "ground_truth"), root))


def folder_pairs(root: str | Path) -> Iterator[StereoPair]:
    """Read every pair under `root` whose names follow one of `LEFT_AND_RIGHT`, such as KITTI's.

    Rectification is assumed.

    Returns:
        Pairs, read one at a time, named by left's path below `root` without suffix and marks that begin a
        name or follow _ (one that is the whole path stays), with `max_disparity` `PAPER_DISPARITY` and no
        true disparity.

    Raises:
        FileNotFoundError: for a missing folder.
        ValueError: for a folder without a pair; while pairs are read, for an image that cannot be.
    """
    root = _folder(root)
    return (_read(root, files) for files in _some(_named(root), root))


def pair_files(root: str | Path) -> list[PairFiles]:
    """List the files of every pair that `middlebury_pairs` and `folder_pairs` would read.

    Returns:
        The files, sorted by the left image's path; as Middlebury's for a left image that both would read.
        Whether Middlebury's true disparities exist is not checked.

    Raises:
        FileNotFoundError: for a missing folder, or right image of Middlebury's.
        ValueError: for a folder without a pair.
    """
    root = _folder(root)
    files = {pair.left: pair for pair in (*_named(root), *_middlebury(root, "right"))}
    return [files[left] for left in _some(sorted(files), root)]


def _folder(root: str | Path) -> Path:
    root = Path(root)
    if not root.is_dir():
        raise FileNotFoundError(f"{root}: no such folder: check the path")
    return root


def _some(items: list[T], root: Path) -> list[T]:
    if not items:
        raise ValueError(f"{root}: holds no stereo pair: check the folder and how its images are named")
    return items


def _middlebury(root: Path, *needed: str) -> list[PairFiles]:
    """Pairs of Middlebury's collections, in order; FileNotFoundError for a missing file."""
    found = sorted(
        PairFiles(file, file.with_name(right), 255 / scale, file.with_name(ground_truth), scale)
        for key, (left, right, ground_truth, scale) in MIDDLEBURY.items()
        for file in files_below(root)
        if file.name == left and any(key in folder for folder in file.parts[-3:-1])
    )
    for path in (getattr(files, name) for files in found for name in needed):
        if not path.is_file():
            raise FileNotFoundError(f"{path}: missing beside its left image: fetch the collection again")
    return found


def _named(root: Path) -> list[PairFiles]:
    """Pairs by their files' names: the first of `LEFT_AND_RIGHT` whose right image exists."""
    before = root.as_posix()
    files: list[PairFiles] = []
    for left in (file for file in files_below(root) if file.suffix.lower() in IMAGE_SUFFIXES):
        inside = left.as_posix()[len(before) :]
        marks = [(mark, other) for mark, other in LEFT_AND_RIGHT if mark in inside]
        rights = (Path(before + other.join(inside.rsplit(mark, 1))) for mark, other in marks)
        files += [PairFiles(left, right, PAPER_DISPARITY) for right in rights if right.is_file()][:1]
    return files


def _read(root: Path, files: PairFiles) -> StereoPair:
    """Read the images and name the pair."""
    left, right, most, ground_truth, scale = files
    name, disparity = left.relative_to(root).with_suffix("").as_posix(), None
    name = re.sub(r"(^|[/_])(L|left|image_2|colored_0|view1|im2|im0)($|/)", r"\3", name).strip("/") or name
    if ground_truth is not None:
        counts = read_image(ground_truth)[0] * 255
        name, disparity = left.parent.relative_to(root).as_posix(), Disparity(counts / scale, counts > 0)
    return StereoPair(name, read_image(left), read_image(right), most, disparity)
