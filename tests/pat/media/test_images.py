import errno
import io
import os
import re
import struct
import sys
import warnings
import zlib
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import skimage.io
import tifffile
import torch
from PIL import Image, ImageOps

from arraygeom.runtime.atomic import write_atomically
from arraygeom.runtime.image_bytes import image_header
from arraygeom.runtime.together import sweep, write_together
from pat.media.colour import from_luma_chroma, luminance, to_luma_chroma
from pat.media.images import decoded_photograph, read_image, read_recorded, write_image
from tests.processes import room_for

RED = torch.tensor([1.0, 0.0, 0.0])[:, None, None]


def make_image(*, channels=3, seed=0):
    return torch.rand(channels, 7, 9, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize(
    ("suffix", "bits"), [("png", 8), ("png", 16), ("tif", 8), ("tif", 16), ("tif", 32), ("ppm", 8)]
)
def test_what_is_written_is_read_back(tmp_path, channels, suffix, bits):
    if suffix == "ppm" and channels == 1:
        suffix = "pgm"
    image = make_image(channels=channels)
    write_image(tmp_path / f"a.{suffix}", image, bits=bits)
    again = read_image(tmp_path / f"a.{suffix}")
    assert again.dtype == torch.float32
    assert again.shape == image.shape
    assert (again - image).abs().max() <= 0.5001 / (2 ** min(bits, 24) - 1)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.float64])
@pytest.mark.parametrize(("suffix", "bits"), [("png", 8), ("tif", 32)])
def test_floats_of_any_precision_are_written(tmp_path, dtype, suffix, bits):
    """NumPy has no bfloat16."""
    image = make_image(channels=3).to(dtype)
    write_image(tmp_path / f"a.{suffix}", image, bits=bits)
    again = read_image(tmp_path / f"a.{suffix}")
    assert (again - image.double()).abs().max() <= 0.5001 / (2 ** min(bits, 24) - 1)


def test_jpeg_is_read_back_nearly(tmp_path):
    image = RED.expand(3, 16, 16)
    write_image(tmp_path / "a.jpg", image)
    assert (read_image(tmp_path / "a.jpg") - image).abs().max() < 0.02


def test_colours_are_in_the_order_red_green_blue(tmp_path):
    cv2.imwrite(str(tmp_path / "red.png"), np.full((4, 5, 3), (0, 0, 255), np.uint8))
    torch.testing.assert_close(read_image(tmp_path / "red.png"), RED.expand(3, 4, 5).contiguous())


def test_sixteen_bits_are_scaled_by_65535(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.array([[0, 257, 65535]], np.uint16))
    torch.testing.assert_close(read_image(tmp_path / "a.png"), torch.tensor([[[0, 1 / 255, 1]]]))


@pytest.mark.parametrize(("largest", "bits"), [(200, 8), (1000, 10), (4095, 12)])
def test_few_bits_in_sixteen_are_said_unless_they_are_stated(tmp_path, largest, bits):
    cv2.imwrite(str(tmp_path / "a.png"), np.array([[0, largest]], np.uint16))
    with pytest.warns(UserWarning, match=f"{largest}.*bits: {bits}"):
        read_image(tmp_path / "a.png")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_image(tmp_path / "a.png", bits=bits)
        cv2.imwrite(str(tmp_path / "a.png"), np.array([[0, 4096]], np.uint16))
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize("content", [b"P1\n4 1\n0 1 0 1\n", b"P4\n4 1\n\x50"])
def test_a_bitmap_has_two_values(tmp_path, content):
    (tmp_path / "a.pbm").write_bytes(content)
    assert read_recorded(tmp_path / "a.pbm").tolist() == [[[255, 0, 255, 0]]]


@pytest.mark.parametrize("white", [1, 31, 100, 255, 1000, 1023, 4095, 40000, 65535])
@pytest.mark.parametrize("kind", [b"P2", b"P3", b"P5", b"P6"])
def test_a_pnm_file_states_its_white(tmp_path, white, kind):
    """White of 100 or 40000 is white, and comments are skipped."""
    values = np.array([[0, white // 5, white // 2, white]], np.uint16)
    stored = values.repeat(3) if kind in (b"P3", b"P6") else values
    text = " ".join(map(str, stored.ravel().tolist())).encode()  # OpenCV wants a line break at its end
    content = text if kind < b"P5" else stored.astype(">u2" if white > 255 else "u1").tobytes()
    (tmp_path / "a.pnm").write_bytes(kind + b" 4 1\n# 0 1\n%d\n" % white + content)
    assert all(np.array_equal(band, values) for band in read_recorded(tmp_path / "a.pnm"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read = read_image(tmp_path / "a.pnm")
    assert torch.allclose(read, torch.from_numpy(values / white).float().expand_as(read))
    photograph = decoded_photograph(tmp_path / "a.pnm", cv2.IMREAD_COLOR)
    wanted = values[..., None] * (255 / white)
    assert abs(photograph - wanted).max() < 0.51 + (white < 255)  # OpenCV rounds those of text by itself


@pytest.mark.parametrize(("white", "kind"), [(100, "u1"), (1000, ">u2")])
def test_values_above_the_white_that_a_pnm_file_states_are_refused(tmp_path, white, kind):
    (tmp_path / "a.pgm").write_bytes(b"P5 2 1 %d\n" % white + np.array([0, white + 1], kind).tobytes())
    with pytest.raises(ValueError, match=f"a.pgm: .*{white + 1}.*{white}"):
        read_image(tmp_path / "a.pgm")


def test_values_outside_the_range_are_cut(tmp_path):
    write_image(tmp_path / "a.png", torch.tensor([[[-0.5, 1.5]]]))
    assert read_image(tmp_path / "a.png").tolist() == [[[0.0, 1.0]]]


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_an_opaque_alpha_channel_is_dropped_and_any_other_refused(tmp_path, kind):
    values = np.full((4, 5, 4), np.iinfo(kind).max, kind)
    cv2.imwrite(str(tmp_path / "opaque.png"), values)
    assert read_image(tmp_path / "opaque.png").shape == (3, 4, 5)
    values[2, 2, 3] -= 1
    cv2.imwrite(str(tmp_path / "glass.png"), values)
    with pytest.raises(ValueError, match=r"glass.png: "):
        read_image(tmp_path / "glass.png")


@pytest.mark.parametrize("mode", ["LA", "L"])
def test_a_grey_png_file_with_alpha_or_a_transparent_level_is_grey(tmp_path, mode):
    """It is one band, not three equal ones."""
    grey = np.arange(20, dtype=np.uint8).reshape(4, 5)
    image = Image.fromarray(grey)
    image.convert(mode).save(tmp_path / "a.png", **({"transparency": 255} if mode == "L" else {}))
    read = read_image(tmp_path / "a.png")
    assert read.shape == (1, 4, 5)
    assert torch.equal(read[0] * 255, torch.from_numpy(grey).float())
    assert read_recorded(tmp_path / "a.png").shape == (1, 4, 5)


def test_a_missing_image_is_named_with_its_camera(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"mono.*nothing.png"):
        read_image(tmp_path / "nothing.png", name="mono")


@pytest.mark.parametrize("content", [b"", b"words", b"\x89PNG\r\n\x1a\n"])
def test_a_file_that_is_no_image_is_refused(tmp_path, content, capfd):
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(ValueError, match=r"a.png: "):
        read_image(tmp_path / "a.png")
    assert not capfd.readouterr().err


@pytest.mark.parametrize("damage", ["cut", "without end", "one byte"])
def test_a_damaged_image_is_refused(damage, tmp_path, capfd):
    """The library that OpenCV reads PNG by wrote a line of its own, or read other pixels."""
    write_image(tmp_path / "a.png", torch.rand(3, 64, 64))
    whole = (tmp_path / "a.png").read_bytes()
    head, middle, tail = whole[:5000], whole[5000], whole[5001:]
    damaged = {"cut": head, "without end": whole[:-12], "one byte": head + bytes([middle ^ 1]) + tail}
    (tmp_path / "a.png").write_bytes(damaged[damage])
    with pytest.raises(ValueError, match=r"a.png: "):
        read_image(tmp_path / "a.png")
    assert capfd.readouterr().err == ""


def planar_tiff(**options) -> bytes:
    """A TIFF file with a plane of its own for each colour, all of 200."""
    file = io.BytesIO()
    tifffile.imwrite(
        file, np.full((3, 60, 80), 200, np.uint8), photometric="rgb", planarconfig="separate", **options
    )
    return file.getvalue()


@pytest.mark.parametrize("options", [{}, {"rowsperstrip": 5}, {"rowsperstrip": 5, "compression": "zlib"}])
def test_half_a_planar_tiff_is_refused(tmp_path, options):
    """OpenCV takes the strips that are missing for black."""
    content = planar_tiff(**options)
    (tmp_path / "whole.tif").write_bytes(content)
    assert read_image(tmp_path / "whole.tif").allclose(torch.tensor(200 / 255))
    (tmp_path / "half.tif").write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"half.tif: "):
        read_image(tmp_path / "half.tif")


def test_the_first_of_several_images_in_a_tiff_is_said_to_be_taken(tmp_path):
    """A recording in one file gives a warning."""
    image = np.full((30, 40), 200, np.uint8)
    tifffile.imwrite(tmp_path / "stack.tif", np.stack([image, image, image]), photometric="minisblack")
    with pytest.warns(UserWarning, match=r"stack\.tif: "):
        assert read_image(tmp_path / "stack.tif").shape == (1, 30, 40)
    with tifffile.TiffWriter(tmp_path / "pyramid.tif") as file:
        file.write(image, photometric="minisblack")
        file.write(image[::2, ::2], photometric="minisblack", subfiletype=1)
        file.write(image > 0, photometric="mask", subfiletype=4)
    tifffile.imwrite(tmp_path / "one.tif", image, photometric="minisblack")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_image(tmp_path / "pyramid.tif")
        read_image(tmp_path / "one.tif")


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def test_the_first_image_of_an_animated_png_is_read(tmp_path):
    """OpenCV's decoder crashes on this one, whose frame is said to be larger than the image."""
    write_image(tmp_path / "a.png", torch.full((1, 12, 16), 0.2))
    still = (tmp_path / "a.png").read_bytes()
    frame = png_chunk(b"fcTL", struct.pack(">IIIIIHHBB", 0, 32, 24, 3, 3, 1, 10, 1, 0))
    animation = png_chunk(b"acTL", struct.pack(">II", 2, 0)) + frame
    (tmp_path / "a.png").write_bytes(still[:33] + animation + still[33:])
    assert read_image(tmp_path / "a.png").allclose(torch.tensor(0.2))


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        (np.array([[0, np.nan]], np.float32), "NaN"),
        (np.array([[0, 200]], np.float32), "0 to 200: scale"),
        (np.array([[0, 5]], np.int16), "int16"),
    ],
)
def test_unusable_values_are_refused(tmp_path, values, complaint):
    cv2.imwrite(str(tmp_path / "a.tif"), values)
    with pytest.raises(ValueError, match=f"a.tif: .*{complaint}"):
        read_image(tmp_path / "a.tif")


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("layout", ["separate", "contig"])
@pytest.mark.parametrize("photometric", ["rgb", "minisblack"])
def test_three_bands_of_a_tiff_are_read_however_they_are_stored(tmp_path, kind, layout, photometric):
    """OpenCV mixes planes of more than 8 bits, and gives the first of bands that are not called colours."""
    values = np.random.default_rng(0).random((3, 9, 7))
    values = values.astype(kind) if kind == np.float32 else (values * np.iinfo(kind).max).astype(kind)
    stored = values if layout == "separate" else values.transpose(1, 2, 0)
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric=photometric, planarconfig=layout)
    assert np.array_equal(read_recorded(tmp_path / "a.tif"), values)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_white_is_white_in_a_tiff_where_0_is(tmp_path, kind):
    """Images of 16 bits are not read as their negatives."""
    values = np.arange(12, dtype=kind).reshape(3, 4)
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="miniswhite")
    assert np.array_equal(read_recorded(tmp_path / "a.tif")[0], np.iinfo(kind).max - values)


@pytest.mark.parametrize(
    ("shape", "kind", "complaint"),
    [
        ((6, 8), np.uint32, "uint32"),
        ((6, 8), np.float16, "float16"),
        ((6, 8, 2), np.uint16, "2 channels"),
        ((6, 8, 4), np.uint8, "4 channels"),
        ((6, 8, 5), np.uint16, "5 channels"),
    ],
)
def test_what_opencv_does_not_read_of_a_tiff_is_named(tmp_path, shape, kind, complaint):
    """Channels are not left out without a word."""
    values = np.ones(shape, kind)
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="minisblack", planarconfig="contig")
    with pytest.raises(ValueError, match=f"a.tif: .*{complaint}"):
        read_image(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("name", "image", "bits", "complaint"),
    [
        ("a.png", torch.full((1, 2, 2), torch.nan), 8, "NaN"),
        ("a.png", torch.zeros(2, 2, 2), 8, "1 or 3 channels"),
        ("a.xyz", torch.zeros(1, 2, 2), 8, r"\.png"),
        ("a", torch.zeros(1, 2, 2), 8, r"\.png"),
        ("a.jpg", torch.zeros(1, 2, 2), 16, "8 bits"),
        ("a.bmp", torch.zeros(1, 2, 2), 16, "8 bits"),
        ("a.png", torch.zeros(1, 2, 2), 32, r"\.tif"),
        ("a.png", torch.zeros(1, 2, 2), 12, "bits"),
    ],
)
def test_what_cannot_be_written_leaves_nothing_behind(tmp_path, name, image, bits, complaint):
    with pytest.raises(ValueError, match=complaint):
        write_image(tmp_path / name, image, bits=bits)
    assert os.listdir(tmp_path) == []


def test_the_written_file_takes_the_place_of_the_former_but_after_an_error(tmp_path):
    def write_half():
        with write_atomically(file) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    file = tmp_path / "b" / "a.txt"  # whose folder is made
    for text in ("old", "new"):
        with write_atomically(file) as temporary:
            assert temporary.suffix == ".txt"
            temporary.write_text(text)
    with pytest.raises(RuntimeError):
        write_half()
    assert os.listdir(tmp_path / "b") == ["a.txt"]
    assert file.read_text() == "new"


def test_luminance_is_opencvs():
    image = make_image()
    theirs = cv2.cvtColor(image.permute(1, 2, 0).numpy(), cv2.COLOR_RGB2GRAY)
    torch.testing.assert_close(luminance(image)[0], torch.from_numpy(theirs), atol=1e-5, rtol=0)


def test_luma_and_chroma_come_back():
    image = torch.rand(2, 3, 5, 6, dtype=torch.float64)
    luma, chroma = to_luma_chroma(image)
    torch.testing.assert_close(from_luma_chroma(luma, chroma), image, atol=1e-14, rtol=0)
    grey = image[:, :1].expand(-1, 3, -1, -1)
    assert to_luma_chroma(grey)[1].abs().max() < 1e-14
    others = torch.randn_like(chroma)  # of no image: the luminance is the given one all the same
    torch.testing.assert_close(luminance(from_luma_chroma(luma, others)), luma, atol=1e-14, rtol=0)


def test_a_file_system_that_is_read_only_is_said_of_the_file_itself(tmp_path, monkeypatch):
    """It refuses the removal of the temporary file, too."""

    def refuse(path, *_, **__):
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    for name in ("write_text", "unlink"):
        monkeypatch.setattr(Path, name, refuse)
    with (
        pytest.raises(OSError, match="Read-only") as caught,
        write_atomically(tmp_path / "a.txt") as temporary,
    ):
        temporary.write_text("a")
    assert caught.value.filename == str(tmp_path / "a.txt")


def test_no_room_is_said_of_the_file_whoever_writes(tmp_path):
    """Also for files that NumPy writes."""
    said = r"a\.npy: not written whole \(.* written\): is there room\?"
    with (
        room_for(1000),
        pytest.raises(OSError, match=said),
        write_atomically(tmp_path / "a.npy") as temporary,
    ):
        np.save(temporary, np.zeros(1000))
    said = rf"{re.escape(str(tmp_path))}: not written whole \("
    together = write_together(tmp_path, group="b", last="b.npy")
    with room_for(1000), pytest.raises(OSError, match=said), together as folder:
        np.save(folder / "b.npy", np.zeros(1000))
    assert os.listdir(tmp_path) == []


def test_what_a_killed_process_left_is_swept_away_and_nothing_else(tmp_path):
    with write_atomically(tmp_path / "a-b.png") as temporary:
        temporary.write_text("half")
        left = tmp_path / temporary.name.replace("a-b", "c")
        left.write_text("half")
    (tmp_path / ".hidden-file.png").write_text("mine")
    sweep(tmp_path)
    sweep(tmp_path / "none")
    assert sorted(os.listdir(tmp_path)) == [".hidden-file.png", "a-b.png"]


def with_orientation(path, image: np.ndarray, orientation: int) -> None:
    """Write an image with an orientation tag by Pillow or tifffile."""
    if path.suffix == ".tif":
        tag = (274, 3, 1, orientation, True)
        kind = "rgb" if image.ndim == 3 else "minisblack"
        tifffile.imwrite(path, image, photometric=kind, extratags=[tag])
        return
    exif = Image.Exif()
    exif[274] = orientation
    options = {".jpg": {"quality": 100, "subsampling": 0}, ".webp": {"lossless": True}}.get(path.suffix, {})
    Image.fromarray(image).save(path, exif=exif, **options)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", ["tif", "png", "jpg", "webp"])
def test_orientation_tags_are_applied_as_viewers_do_and_said(tmp_path, suffix, orientation):
    path = tmp_path / f"a.{suffix}"
    image = np.random.default_rng(0).integers(0, 255, (16, 24, 3), np.uint8)
    with_orientation(path, image, orientation)
    # Pillow rotates TIFF files itself.
    stored = np.asarray(Image.open(path)) if suffix == "jpg" else image
    shown = np.asarray(ImageOps.exif_transpose(Image.open(path)))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for how, wanted in (("apply", shown), ("ignore", stored)):
            read = read_image(path, orientation=how, hw=wanted.shape[:2])
            assert (read.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8).tolist() == wanted.tolist()
    words = [f"a.{suffix}: orientation tag {orientation} is {how}" for how in ("applied", "ignored")]
    assert len(said) == (0 if orientation == 1 else 2)
    assert all(word in str(warning.message) for word, warning in zip(words, said))


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
@pytest.mark.filterwarnings("ignore:.*orientation tag")
def test_orientation_does_not_depend_on_the_type_of_values(tmp_path, kind):
    image = np.arange(24).reshape(4, 6).astype(kind) / (np.float32(24) if kind == np.float32 else kind(1))
    white = 1 if kind == np.float32 else np.iinfo(kind).max
    for orientation in range(1, 9):
        with_orientation(tmp_path / "a.tif", image.astype(kind), orientation)
        stored = read_image(tmp_path / "a.tif", orientation="ignore")[0]
        assert torch.allclose(stored, torch.from_numpy(image.astype(np.float32)) / white)
        shape = (4, 6) if orientation < 5 else (6, 4)
        assert read_image(tmp_path / "a.tif").shape[1:] == shape


def png_that_claims(width: int, height: int) -> bytes:
    head = struct.pack(">II5B", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", head)


def test_the_size_is_compared_before_anything_is_decoded(tmp_path, monkeypatch):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    (tmp_path / "a.png").write_bytes(png_that_claims(30_000, 30_000))
    with pytest.raises(ValueError, match=r"mono: .*a.png: .*30000x30000.* 640x400"):
        read_image(tmp_path / "a.png", name="mono", hw=(400, 640))
    with pytest.raises(ValueError, match=r"a.png: "):
        read_image(tmp_path / "a.png")


def test_the_size_of_a_heic_file_is_compared_before_it_is_decoded(tmp_path, monkeypatch):
    """With a stand-in for pillow-heif, which opens a file without decoding it."""

    class Stored:
        size = 30_000, 20_000

        def __array__(self, *_, **__):
            pytest.fail("decoded")

    stand_in = SimpleNamespace(open_heif=lambda *_, **__: Stored())
    monkeypatch.setitem(sys.modules, "pillow_heif", stand_in)
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic")
    for hw, words in ((None, "268"), ((400, 640), "640x400")):
        with pytest.raises(ValueError, match=rf"a.heic: .*30000x20000.*{words}"):
            read_image(tmp_path / "a.heic", hw=hw)


@pytest.mark.parametrize("suffix", ["png", "tif", "jpg", "ppm", "pgm", "bmp", "webp"])
@pytest.mark.parametrize("shape", [(1, 1), (3, 700), (300, 5)])
def test_headers_state_the_size_of_every_format(tmp_path, suffix, shape):
    colours = 1 if suffix == "pgm" else 3
    write_image(tmp_path / f"a.{suffix}", torch.rand(colours, *shape))
    content = (tmp_path / f"a.{suffix}").read_bytes()
    assert image_header(content).hw == shape
    for cut in range(0, len(content), max(1, len(content) // 40)):
        image_header(content[:cut])


def test_a_tiff_of_two_widths_has_no_header(tmp_path):
    """The width's tag with as many values as the file states, not one."""
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((3, 4), np.uint8))
    content = bytearray((tmp_path / "a.tif").read_bytes())
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        place = file.pages.first.tags["ImageWidth"].offset
    struct.pack_into("<HII", content, place + 2, 3, 2, 4)  # as two values of 16 bits
    assert image_header(bytes(content)) is None


def test_comments_bigtiff_and_damaged_orientation(tmp_path):
    (tmp_path / "a.pgm").write_bytes(b"P5 # by hand\n#\n3\t2\n255\n" + bytes(6))
    assert read_image(tmp_path / "a.pgm").shape == (1, 2, 3)
    tifffile.imwrite(tmp_path / "big.tif", np.zeros((3, 4), np.uint16), bigtiff=True, byteorder=">")
    assert image_header((tmp_path / "big.tif").read_bytes())[:3] == ((3, 4), 1, 16)
    with_orientation(tmp_path / "b.png", np.zeros((3, 4, 3), np.uint8), 9)
    assert read_image(tmp_path / "b.png").shape == (3, 3, 4)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("bits", [8, 16, 32])
def test_tiffs_are_read_by_all_without_further_codecs(bits, channels, tmp_path):
    """No LZW with a predictor of floats, which some versions of OpenCV write and tifffile refuses."""
    image = torch.rand(channels, 12, 17)
    write_image(tmp_path / "a.tif", image, bits=bits)
    scale = 1 if bits == 32 else 2**bits - 1
    readers = {
        "tifffile": tifffile.imread,
        "scikit-image": skimage.io.imread,
        "OpenCV": lambda path: cv2.imread(str(path), cv2.IMREAD_UNCHANGED),
    }
    if bits == 8 or channels == 1:  # Pillow has no colours of more bits
        readers["Pillow"] = lambda path: np.asarray(Image.open(path))
    wanted = image.permute(1, 2, 0).numpy()
    for reader, read in readers.items():
        values = read(tmp_path / "a.tif").reshape(wanted.shape)
        values = values[..., ::-1] if reader == "OpenCV" else values
        np.testing.assert_allclose(
            values / scale, wanted, atol=0 if bits == 32 else 0.5 / scale, err_msg=reader
        )
