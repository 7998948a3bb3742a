"""Frames to a video file, and from one."""

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

from arraygeom.atomic import write_atomically
from arraygeom.extras import needs

from .colour import to_bytes


def write_video(path: str | Path, frames: Iterable[Float[Tensor, "c h w"]], *, rate: float = 25.0) -> None:
    """Write images (grey or RGB, sRGB values, clipped to 0..1) as H.264 (.mp4, .mkv), atomically.

    An odd last row or column is left out: 4:2:0 has none. Raises ValueError for no frames, frames of different sizes,
    and other suffixes.
    """
    path = Path(path)
    if path.suffix.lower() not in (".mp4", ".mkv"):
        raise ValueError(f"{path}: a video's name ends in .mp4 or .mkv")
    with needs("video", "writing video"):
        import av
    with write_atomically(path) as temporary, av.open(str(temporary), "w") as file:
        stream = None
        for frame in frames:
            h, w = (n // 2 * 2 for n in frame.shape[-2:])
            pixels = np.ascontiguousarray(to_bytes(frame[..., :h, :w].expand(3, -1, -1)).transpose(1, 2, 0))
            if stream is None:
                stream = file.add_stream("libx264", rate=Fraction(rate).limit_denominator(1000))
                stream.height, stream.width = pixels.shape[:2]
                stream.pix_fmt, stream.options = "yuv420p", {"crf": "16", "preset": "medium"}
            if pixels.shape[:2] != (stream.height, stream.width):
                raise ValueError(f"{path}: the frames of a video are of one size")
            file.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        if stream is None:
            raise ValueError(f"{path}: a video needs at least one frame")
        file.mux(stream.encode())


class Video(NamedTuple):
    """The frames of a video file, (3, H, W), 0..1, read as they are asked for, and how many there are a second."""

    frames: Iterator[Float[Tensor, "3 h w"]]
    rate: float


def read_video(path: str | Path) -> Video:
    """A video of any format that OpenCV reads. Raises FileNotFoundError, or ValueError for no video."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such video: check the path")
    video = cv2.VideoCapture(str(path))
    rate = video.get(cv2.CAP_PROP_FPS)
    if not video.isOpened() or not rate > 0:
        raise ValueError(f"{path}: not a video that can be read: convert it to .mp4, or save images from it")
    return Video(_frames(video), rate)


def _frames(video: cv2.VideoCapture) -> Iterator[Float[Tensor, "3 h w"]]:
    done, frame = video.read()
    while done:
        yield torch.from_numpy(np.ascontiguousarray(frame[..., ::-1].transpose(2, 0, 1))).float() / 255
        done, frame = video.read()
    video.release()
