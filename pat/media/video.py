"""Video files: writing and reading frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom.runtime.atomic import write_atomically
from arraygeom.runtime.extras import needs

from .colour import to_bytes


def write_video(path: str | Path, frames: Iterable[Float[Tensor, "c h w"]], *, rate: float = 25.0) -> None:
    """Write images as an H.264 video (.mp4, .mkv), atomically.

    Args:
        frames: images (1 or 3, h, w), grey or RGB, sRGB values, clipped to 0..1, taken one at a time; an odd
            last row or column is left out, as 4:2:0 needs even sides.
        rate: frames for each second.

    Raises:
        ImportError: without the extra `video`.
        ValueError: for no frames, frames of different sizes, under 2 x 2 or of other channels, another
            suffix, or a rate outside .001 to 1000.
        OSError: if it cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in (".mp4", ".mkv"):
        raise ValueError(f"{path}: a video's name ends in .mp4 or .mkv")
    check_video(rate)
    import av

    with write_atomically(path) as temporary, av.open(str(temporary), "w") as file:
        stream = None
        for frame in frames:
            h, w = (n // 2 * 2 for n in frame.shape[-2:])
            if not (h and w and len(frame) in (1, 3)):
                raise ValueError(f"{path}: the frames of a video are grey or RGB, of at least 2 x 2 pixels")
            pixels = np.ascontiguousarray(to_bytes(frame[..., :h, :w].expand(3, -1, -1)).transpose(1, 2, 0))
            if stream is None:
                stream = file.add_stream("libx264", rate=Fraction(rate).limit_denominator(1000))
                stream.height, stream.width = pixels.shape[:2]
                stream.pix_fmt, stream.options = "yuv420p", {"crf": "16", "preset": "medium"}
            if pixels.shape[:2] != (stream.height, stream.width):
                raise ValueError(f"{path}: all frames of a video must have the size of the first")
            file.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        if stream is None:
            raise ValueError(f"{path}: a video needs at least one frame")
        file.mux(stream.encode())


def check_video(rate: float) -> None:
    """Check before frames are made that a video can be written.

    Raises:
        ImportError: without the extra `video`.
        ValueError: for a rate outside .001 to 1000 frames a second.
    """
    with needs("video", "writing video"):
        import av  # noqa: F401
    if not 1e-3 <= rate <= 1e3:
        raise ValueError(f"a video of {rate:g} frames a second: give .001 to 1000")


class Video(NamedTuple):
    """Frames of a video file, read as they are asked for.

    Attributes:
        frames: iterator, to be read once, of sRGB images 0..1, float32: RGB (3, h, w), or all of them grey
            (1, h, w) if the first is grey (`is_grey`).
        rate: frames for each second.
    """

    frames: Iterator[Float[Tensor, "c h w"]]
    rate: float


def read_video(path: str | Path) -> Video:
    """Open a video file of any format that OpenCV reads.

    Returns:
        Its frames, decoded on demand, and their rate. Frames end without an error where the file is damaged.

    Raises:
        FileNotFoundError: for a missing file.
        ValueError: for a file that OpenCV does not open, or that states no rate.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such video: check the path")
    video = cv2.VideoCapture(str(path))
    rate = video.get(cv2.CAP_PROP_FPS)
    if not video.isOpened() or not rate > 0:
        raise ValueError(f"{path}: not a video that can be read: convert it to .mp4, or save images from it")
    return Video(_frames(video), rate)


GREY_ROUNDED = 4 / 255
"""Colour difference to which codecs round grey: for MPEG-4 in OpenCV's conversion, 3 counts of 255."""
CONTRAST = 10.0
"""Ratio of brightness range to colour difference above which a picture is grey: a black one is not."""


def is_grey(image: Float[Tensor, "3 h w"]) -> bool:
    """Return True for a decoded picture with contrast whose colours differ only by a codec's rounding."""
    differences = image.amax(0) - image.amin(0)
    low, high = image[1].aminmax()
    return float(differences.max()) < min(GREY_ROUNDED, float(high - low) / CONTRAST)


def _frames(video: cv2.VideoCapture) -> Iterator[Float[Tensor, "c h w"]]:
    grey = None
    succeeded, frame = video.read()
    while succeeded:
        image = torch.from_numpy(np.ascontiguousarray(frame[..., ::-1].transpose(2, 0, 1))).float() / 255
        grey = is_grey(image) if grey is None else grey
        yield image[1:2] if grey else image
        succeeded, frame = video.read()
    video.release()
