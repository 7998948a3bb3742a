"""Assignment of the images in a folder to cameras and moments: subfolders, file names, videos.

A camera is a subfolder, or a prefix of file names in one folder, or a pattern. Images of one moment have the
same number (or name, but for runs of digits or of other characters that all names of a camera share; if the
cameras share none, but for words that all share).
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageOps

from arraygeom.runtime.image_bytes import ORIENTATION, decoded

Grey = UInt8[np.ndarray, "h w"]

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp"}
VIDEOS = {".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg"}
MOST_FRAMES = 80
"""Largest number of frames used from a video: every first, second, fourth, eighth ..., so that videos of
somewhat different lengths share them."""

FrameKey = int | str


@dataclass(frozen=True)
class Photo:
    """One image of one camera, decoded when needed.

    Attributes:
        label: name in messages.
        decode: function that decodes the image, to an array as `to_grey` takes it.
    """

    label: str
    decode: Callable[[], np.ndarray]

    def read(self) -> Grey:
        """Decode the image in grey, 8 bits (see `to_grey`).

        Raises:
            ValueError, OSError: if it cannot be read.
        """
        return to_grey(self.decode())


Photos = Mapping[str, Mapping[FrameKey, Photo]]
"""Images by camera, then by moment."""


def to_grey(image: np.ndarray) -> Grey:
    """Convert an image (h, w) or (h, w, c) to grey, 8 bits, stretched to 0..255.

    Images of 8 bits whose values span more than 100 are not stretched. Of one or two channels the first is
    grey; of more, the first three are blue, green and red. Stretching clips half a percent at either end; NaN
    and infinity, and an image of one value, become black.

    Returns:
        Grey image (h, w), uint8; it may share the memory of `image`.
    """
    image = np.atleast_3d(image if image.dtype in (np.uint8, np.uint16) else image.astype(np.float32))
    grey = image[..., 0] if image.shape[2] < 3 else cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2GRAY)
    sample = grey[::4, ::4][np.isfinite(grey[::4, ::4])]
    low, high = np.percentile(sample, (0.5, 99.5)) if len(sample) else (0.0, 0.0)
    if grey.dtype == np.uint8 and high - low > 100:
        return grey
    least = 1e-6 if grey.dtype == np.float32 else 1.0
    scaled = (np.where(np.isfinite(grey), grey, low).astype(np.float32) - low) * (
        255 / max(high - low, least)
    )
    return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)


def find_photos(folder: Path, *, patterns: Mapping[str, str] | None = None) -> Photos:
    """Find the images of every camera below a folder.

    Args:
        patterns: patterns of file names, relative to the folder, by camera; None takes each subfolder with
            images or a video as a camera, or else each prefix of file names before a final number
            (left01.jpg, right01.jpg) or each video. If each camera has one image, these are of one moment.

    Returns:
        Images by camera and moment (see `frame_keys`; of a video the number of the frame, of which at most
        `MOST_FRAMES` are taken), not decoded yet.

    Raises:
        OSError: for a folder that is missing (FileNotFoundError) or cannot be read.
        ValueError: for no images, images beside subfolders of images, patterns that are whole paths, without
            a file or with a shared one, images of a camera that differ in orientation tags or repeat a
            number, a video among other files or that cannot be read, and images of too many pixels.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder: give one with a subfolder for each camera")
    cameras = _by_pattern(folder, patterns) if patterns else _by_folder_or_name(folder)
    if not cameras:
        raise ValueError(f"{folder}: no images or videos: give a folder with a subfolder for each camera")
    for words in (False, True):
        photos = {name: _moments(name, files, words) for name, files in cameras.items()}
        keys = {key for moments in photos.values() for key in moments}
        if len(photos) == 1 or len(keys) < sum(map(len, photos.values())):
            break
    if len(keys) == 1 or any(len(moments) > 1 for moments in photos.values()):
        return photos
    # of one moment: numbers in the files' names are the cameras'
    return {name: dict(zip(["image 1"], moments.values())) for name, moments in photos.items()}


def frame_keys(stems: list[str], *, words: bool = False) -> list[FrameKey]:
    """Derive the moments of one camera's images: the part in which names differ, as a number if it is one.

    >>> frame_keys(["cam01_08_int", "cam01_09_int", "cam01_10_int"])
    [8, 9, 10]

    Args:
        stems: file names without suffix, at least one, compared by runs of digits and of other characters.
        words: True to part these at spaces, "_", "." and "-" too, as in left_near and left_far.

    Returns:
        One key for each name, in order; equal keys are not refused. For a single name its last number, or the
        name itself.
    """
    if len(stems) == 1:
        numbers = re.findall(r"\d+", stems[0])
        return [int(numbers[-1]) if numbers else stems[0]]
    pieces = [re.split(r"(\d+|[ _.-]+)" if words else r"(\d+)", stem) for stem in stems]
    head = _common_prefix(pieces)
    tail = _common_prefix([p[head:][::-1] for p in pieces])
    middles = ["".join(p[head : len(p) - tail]) for p in pieces]
    return [int(m) if m.isdecimal() else m for m in middles]


def _common_prefix(lists: list[list[str]]) -> int:
    """Number of first items that all lists share."""
    return next((i for i, items in enumerate(zip(*lists)) if len(set(items)) > 1), min(map(len, lists)))


def _by_pattern(folder: Path, patterns: Mapping[str, str]) -> dict[str, list[Path]]:
    if wrong := [pattern for pattern in patterns.values() if Path(pattern).is_absolute()]:
        raise ValueError(f"'{wrong[0]}' is a whole path: give a pattern of names in {folder}, as 'left*.jpg'")
    cameras = {name: _usable(folder.glob(pattern)) for name, pattern in patterns.items()}
    if empty := [name for name, files in cameras.items() if not files]:
        raise ValueError(f"{empty[0]}: no image or video in {folder} is called '{patterns[empty[0]]}'")
    for (a, files), (b, others) in combinations(cameras.items(), 2):
        if both := [file.name for file in files if file in others]:
            raise ValueError(f"{both[0]} is an image of {a} and of {b}: give patterns of which one fits it")
    return cameras


def _by_folder_or_name(folder: Path) -> dict[str, list[Path]]:
    folders, names = _by_folder(folder), _by_name(folder)
    if folders and names:
        raise ValueError(
            f"{folder}: holds images, such as {next(iter(names.values()))[0].name}, and folders of images "
            f"({', '.join(folders)}): move away those of no board, or give --camera NAME=PATTERN for each "
            "camera"
        )
    return folders or names


def _by_folder(folder: Path) -> dict[str, list[Path]]:
    folders = sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))
    return {p.name: files for p in folders if (files := _usable(p.iterdir()))}


def _by_name(folder: Path) -> dict[str, list[Path]]:
    cameras: dict[str, list[Path]] = {}
    for path in _usable(folder.iterdir()):
        name = path.stem if path.suffix.lower() in VIDEOS else re.sub(r"[ _.-]*\d+$", "", path.stem)
        cameras.setdefault(name or "camera", []).append(path)
    return cameras


def _usable(paths: Iterable[Path]) -> list[Path]:
    files = sorted(p for p in paths if p.is_file() and not p.name.startswith("."))
    return [p for p in files if p.suffix.lower() in IMAGE_SUFFIXES | VIDEOS]


def _moments(name: str, files: list[Path], words: bool) -> dict[FrameKey, Photo]:
    """Photos of a camera by moment. Raises ValueError for mixed videos, orientations, or equal numbers."""
    videos = [f for f in files if f.suffix.lower() in VIDEOS]
    if len(videos) > 1 or (videos and len(videos) < len(files)):
        raise ValueError(f"{name}: {len(videos)} videos among {len(files)} files: keep one video, or images")
    if videos:
        return dict(_video_frames(videos[0]))
    tags: dict[int, str] = {}
    for file in files:
        tags.setdefault(_orientation(file), file.name)
    if len(tags) > 1:  # they are applied: images stored alike would otherwise be rotated differently
        listed = ", ".join(f"{tag} in {file}" for tag, file in tags.items())
        raise ValueError(f"{name}: its images differ in orientation tags ({listed}): remove the tags")
    keys = frame_keys([f.stem for f in files], words=words)
    if len(set(keys)) < len(keys):
        raise ValueError(f"{name}: two images have one number, such as {files[0].name}: give each its own")
    return {key: Photo(file.name, partial(_decode_file, file)) for key, file in zip(keys, files)}


def _orientation(file: Path) -> int:
    """EXIF orientation; 1 without, or if unreadable. ValueError for more pixels than a camera has."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(file) as image:
                return int(image.getexif().get(ORIENTATION, 1))
    except Image.DecompressionBombError as error:
        raise ValueError(f"{file}: {error}: give the photograph itself, or a smaller copy") from None
    except (OSError, SyntaxError, TypeError, ValueError):
        return 1


def _decode_file(path: Path) -> np.ndarray:
    tag, content = _orientation(path), path.read_bytes()
    # orientation tags are applied, as when images are fused
    image = decoded(content, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR)
    if image is None:
        raise ValueError(f"{path}: not an image that can be read: give a complete PNG, TIFF or JPEG file")
    if tag > 1 and content[8:12] == b"WEBP":  # of which OpenCV applies none
        with Image.open(path) as stored:
            return cv2.cvtColor(np.asarray(ImageOps.exif_transpose(stored).convert("RGB")), cv2.COLOR_RGB2BGR)
    return image


def _video_frames(path: Path) -> Iterator[tuple[int, Photo]]:
    video = cv2.VideoCapture(str(path))
    count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    video.release()
    if count < 1:
        raise ValueError(f"{path}: not a video that can be read: save images from it, or convert it to .mp4")
    step = 1 << max(0, math.ceil(math.log2(count / MOST_FRAMES)))
    for index in range(0, count, step):
        yield index, Photo(f"{path.name} frame {index}", partial(_decode_frame, path, index))


def _decode_frame(path: Path, index: int) -> np.ndarray:
    video = cv2.VideoCapture(str(path))
    video.set(cv2.CAP_PROP_POS_FRAMES, index)
    succeeded, image = video.read()
    video.release()
    if not succeeded:
        raise ValueError(f"{path}: frame {index} cannot be read: is the video complete?")
    return image
