"""Compressed pixels with four damaged bytes: what the decoders report is an error, and nothing is printed."""

from io import BytesIO

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from arraygeom.runtime.image_bytes import decodable
from pat.app.sample_array import SAMPLE
from pat.media.images import read_image, read_recorded

IMAGE = cv2.imread(str(SAMPLE / "colour.png"))


def opencv(suffix, *options, image=IMAGE) -> bytes:
    return cv2.imencode(suffix, image, options)[1].tobytes()


def by_tifffile(image, **options) -> bytes:
    file = BytesIO()
    tifffile.imwrite(file, image, compression="zlib", photometric="rgb", **options)
    return file.getvalue()


def by_pillow(image, compression) -> bytes:
    file = BytesIO()
    Image.fromarray(image).save(file, "TIFF", compression=compression)
    return file.getvalue()


LZW = (cv2.IMWRITE_TIFF_COMPRESSION, 5)
FILES = {
    "jpeg": (lambda: opencv(".jpg"), 8),
    "grey jpeg": (lambda: opencv(".jpg", image=IMAGE[..., 1]), 8),
    "progressive jpeg": (lambda: opencv(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1), 10),
    "lzw": (lambda: opencv(".tif", *LZW), 1),
    "lzw of 16 bits": (
        lambda: opencv(".tif", *LZW, image=IMAGE * np.uint16(257)),
        1,
    ),
    "grey lzw": (lambda: by_pillow(IMAGE[..., 1], "tiff_lzw"), 1),
    "packbits of 16 bits": (lambda: by_pillow(IMAGE[..., 1] * np.uint16(257), "packbits"), 2),
    "deflate": (lambda: opencv(".tif", cv2.IMWRITE_TIFF_COMPRESSION, 8), 0),
    "deflated tiles": (lambda: by_tifffile(IMAGE, tile=(64, 64)), 0),
    "deflated planes": (
        lambda: by_tifffile(IMAGE.transpose(2, 0, 1), planarconfig="separate", rowsperstrip=7),
        0,
    ),
    "tiff of jpeg": (lambda: by_pillow(IMAGE, "jpeg"), 9),
}
"""Files, and how many of 30 damaged ones are read at most: where codes are still codes nothing reports it."""


@pytest.mark.parametrize("kind", FILES)
def test_damaged_compressed_pixels_are_refused(kind, tmp_path, capfd):
    make, most = FILES[kind]
    content, rng, read = make(), np.random.default_rng(0), 0
    path = tmp_path / ("a.jpg" if content[:2] == b"\xff\xd8" else "a.tif")
    path.write_bytes(content)
    assert read_image(path).shape[1:] == IMAGE.shape[:2]
    for _ in range(30):
        damaged = bytearray(content)
        for place in rng.integers(700, len(content) - 300, 4):
            damaged[place] ^= int(rng.integers(1, 256))
        read += decodable(bytes(damaged)) is not None
        if decodable(bytes(damaged)) is None:
            path.write_bytes(damaged)
            with pytest.raises(ValueError, match=path.name):
                read_recorded(path)
    assert read <= most
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("compression", ["lzw", "packbits", "deflate"])
def test_files_of_ffmpeg_are_whole(compression):
    av = pytest.importorskip("av")
    encoder = av.CodecContext.create("tiff", "w")
    encoder.height, encoder.width = IMAGE.shape[:2]
    encoder.pix_fmt, encoder.options = "rgb24", {"compression_algo": compression}
    content = bytes(encoder.encode(av.VideoFrame.from_ndarray(IMAGE, "rgb24"))[0])
    assert decodable(content) == content


@pytest.mark.parametrize("image", [IMAGE, IMAGE[..., 1], IMAGE[:7, :5]])
def test_jpegs_have_the_pixels_that_opencv_gives(image, tmp_path):
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), image)
    planes = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    planes = planes[None] if planes.ndim == 2 else planes[..., ::-1].transpose(2, 0, 1)
    assert (read_recorded(path) == planes).all()
