"""Colour profiles: others are converted to sRGB on reading, with a warning; raw files need an extra."""

import sys
import time
import warnings
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import tifffile
import torch
from PIL import Image, ImageCms

from pat.media.colour import srgb_from_linear
from pat.media.images import read_image, srgb_profile, write_image

COLOURS = np.random.default_rng(0).integers(20, 236, (8, 9, 3), np.uint8)


def profile_of(primaries: tuple[float, ...], called: str = "wide built-in") -> bytes:
    """Return the profile of sRGB with the columns of another matrix of colorants, and a name of as many
    letters."""
    content = bytearray(srgb_profile())
    for i, name in enumerate((b"rXYZ", b"gXYZ", b"bXYZ")):
        at = int.from_bytes(content[content.index(name) + 4 :][:4], "big")
        for k in range(3):
            value = round(primaries[3 * k + i] * 65536)
            content[at + 8 + 4 * k : at + 12 + 4 * k] = value.to_bytes(4, "big", signed=True)
    return (
        bytes(content)
        .replace(b"sRGB built-in", called.encode())
        .replace("sRGB built-in".encode("utf-16-be"), called.encode("utf-16-be"))
    )


DISPLAY_P3 = (0.5151, 0.2920, 0.1571, 0.2412, 0.6922, 0.0666, -0.0011, 0.0419, 0.7841)


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif", "heic"])
def test_another_profile_is_converted_and_said(suffix, tmp_path, monkeypatch):
    """A HEIC file's, too, with a stand-in for pillow-heif."""
    path = tmp_path / f"p3.{suffix}"
    options = {"quality": 100, "subsampling": 0} if suffix == "jpg" else {}
    flat = np.full((8, 9, 3), (200, 60, 60), np.uint8)
    if suffix == "heic":
        path.write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic")
        stored = Image.fromarray(flat)
        stored.info["icc_profile"] = profile_of(DISPLAY_P3)
        monkeypatch.setitem(sys.modules, "pillow_heif", SimpleNamespace(open_heif=lambda *_, **__: stored))
    else:
        Image.fromarray(flat).save(path, icc_profile=profile_of(DISPLAY_P3), **options)
    with pytest.warns(UserWarning, match="'wide"):
        red, green, _ = (255 * read_image(path)[:, 4, 4]).tolist()
    assert red > 205
    assert green < 55


def test_linear_srgb_is_another_profile(tmp_path):
    """Such images, as of GIMP, are not sRGB, whatever the name."""
    profile = profile_of(DISPLAY_P3, "Linear sRGB 1")
    Image.fromarray(COLOURS).save(tmp_path / "a.png", icc_profile=profile)
    with pytest.warns(UserWarning, match="'Linear sRGB"):
        read_image(tmp_path / "a.png")


def test_images_of_srgb_are_as_they_are(tmp_path):
    Image.fromarray(COLOURS).save(tmp_path / "a.png", icc_profile=srgb_profile())
    Image.fromarray(COLOURS).save(tmp_path / "b.png")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert torch.equal(read_image(tmp_path / "a.png"), read_image(tmp_path / "b.png"))


def test_the_same_image_is_the_same_file_at_any_time(tmp_path):
    written = []
    for seconds in (0, 1.1):
        time.sleep(seconds)
        srgb_profile.cache_clear()
        write_image(tmp_path / "a.png", torch.zeros(3, 4, 5), profile=True)
        written.append((tmp_path / "a.png").read_bytes())
    assert written[0] == written[1]


def test_what_cannot_be_converted_is_said(tmp_path):
    Image.fromarray(COLOURS).save(tmp_path / "a.png", icc_profile=b"x" * 200)
    with pytest.warns(UserWarning, match="profile"):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_a_written_profile_is_read_by_others(suffix, tmp_path):
    image = torch.from_numpy(COLOURS).movedim(-1, 0) / 255
    write_image(tmp_path / f"a.{suffix}", image, profile=True)
    with Image.open(tmp_path / f"a.{suffix}") as opened:
        opened.load()
        assert opened.info["icc_profile"] == srgb_profile()
        assert ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))
    if suffix == "png":
        assert torch.equal(read_image(tmp_path / "a.png"), image)
        assert cv2.imread(str(tmp_path / "a.png")) is not None
    write_image(tmp_path / f"grey.{suffix}", image[:1], profile=True)
    with Image.open(tmp_path / f"grey.{suffix}") as opened:
        assert "icc_profile" not in opened.info


def test_raw_files_name_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rawpy", None)
    (tmp_path / "a.dng").write_bytes(b"II*\0")
    with pytest.raises(ValueError, match=r"'\.\[raw\]'"):
        read_image(tmp_path / "a.dng")


def write_dng(path, cfa):
    """A raw file of an RGGB mosaic whose colours are those of linear sRGB."""
    matrix = [3.2405, -1.5371, -0.4985, -0.9693, 1.8760, 0.0416, 0.0556, -0.2040, 1.0572]
    tags = [
        (33421, "H", 2, (2, 2), True),
        (33422, "B", 4, bytes((0, 1, 1, 2)), True),
        (50706, "B", 4, bytes((1, 4, 0, 0)), True),
        (50708, "s", 0, "A camera", True),
        (50717, "I", 1, 65535, True),
        (50721, "2i", 9, tuple(n for value in matrix for n in (round(value * 10_000), 10_000)), True),
        (50728, "2I", 3, (1, 1) * 3, True),
        (50778, "H", 1, 21, True),
    ]
    tifffile.imwrite(path, cfa, photometric=32803, extratags=tags)


def test_raw_files_are_developed(tmp_path):
    pytest.importorskip("rawpy", reason="the extra 'raw' is not installed")
    light = np.zeros((64, 96, 3))
    light[:, :48], light[:, 48:] = (0.2, 0.5, 0.6), (0.6, 0.3, 0.15)
    cfa = np.zeros((64, 96), np.uint16)
    for y, x, band in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        cfa[y::2, x::2] = 60_000 * light[y::2, x::2, band]
    write_dng(tmp_path / "a.dng", cfa)
    image = read_image(tmp_path / "a.dng")
    assert image.shape == (3, 64, 96)
    for x, colour in ((20, (0.2, 0.5, 0.6)), (80, (0.6, 0.3, 0.15))):
        wanted = srgb_from_linear(torch.tensor(colour)[:, None, None])[:, 0, 0]
        torch.testing.assert_close(image[:, 32, x] / image[1, 32, x], wanted / wanted[1], atol=0.02, rtol=0)
