"""Which image belongs to which camera and moment."""

import struct
import zlib

import cv2
import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from calib.boards.photos import find_photos, frame_keys


def write(path, value=0, hw=(48, 64)):
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.full(hw, value, np.uint8)
    image[::8] = 255
    cv2.imwrite(str(path), image)


@pytest.mark.parametrize(
    ("stems", "keys"),
    [
        (["left01", "left02", "left10"], [1, 2, 10]),
        (["cam01_08_int", "cam01_09_int", "cam01_10_int"], [8, 9, 10]),
        (["1", "2", "11"], [1, 2, 11]),
        (["board near", "board far"], ["board near", "board far"]),
        (["img_007_left"], [7]),
        (["a1_x", "a2_y"], ["1_x", "2_y"]),
    ],
)
def test_keys(stems, keys):
    assert frame_keys(stems) == keys


@given(
    st.lists(st.integers(0, 9999), min_size=2, max_size=12, unique=True),
    st.sampled_from(["cam2_", "x", "a-1-"]),
)
def test_numbers_come_back_whatever_is_around_them(numbers, name):
    assert frame_keys([f"{name}{n:03d}_raw8" for n in numbers]) == numbers


def test_a_folder_for_each_camera(tmp_path):
    for camera, prefix in (("mono", "m_"), ("nir", "nir2_")):
        for i in (1, 2, 3):
            write(tmp_path / camera / f"{prefix}{i:02d}.png")
    (tmp_path / "notes.txt").write_text("no camera")
    photos = find_photos(tmp_path)
    assert {name: list(moments) for name, moments in photos.items()} == {"mono": [1, 2, 3], "nir": [1, 2, 3]}
    assert photos["mono"][2].label == "m_02.png"
    assert photos["mono"][2].read().shape == (48, 64)


def test_images_beside_folders_of_images_are_refused(tmp_path):
    """Thumbnails beside folders are not taken for the only camera."""
    for name in ("left1", "right1", "thumbnails/left1", "thumbnails/right1"):
        write(tmp_path / f"{name}.png")
    with pytest.raises(ValueError, match=r"left1.png"):
        find_photos(tmp_path)
    assert len(find_photos(tmp_path, patterns={"left": "left*.png", "right": "right*.png"})) == 2


def test_names_that_begin_with_the_camera(tmp_path):
    for name in ("left1", "left2", "right1", "right3"):
        write(tmp_path / f"{name}.png")
    assert {n: list(m) for n, m in find_photos(tmp_path).items()} == {"left": [1, 2], "right": [1, 3]}


@pytest.mark.parametrize(
    ("names", "shared"),
    [
        (["left/left_near", "left/left_far", "right/right_near", "right/right_far"], {"near", "far"}),
        (["left/1_a left", "left/2_b left", "right/1_a right", "right/2_b right"], {"1_a", "2_b"}),
        (["left/pose_near", "left/pose_far", "right/pose_near", "right/pose_far", "right/sky"], 2),
        (["left/near", "left/far", "right/left", "right/right"], 0),
    ],
)
def test_moments_with_the_cameras_name_are_found_if_no_other_is_shared(names, shared, tmp_path):
    for name in names:
        write(tmp_path / f"{name}.png")
    left, right = (moments.keys() for moments in find_photos(tmp_path).values())
    assert (left & right == shared) if isinstance(shared, set) else len(left & right) == shared


def test_one_image_of_each_camera_is_one_moment(tmp_path):
    for name in ("cam-0", "cam-1"):
        write(tmp_path / f"{name}.png")
    found = find_photos(tmp_path, patterns={"cam-0": "cam-0.png", "cam-1": "cam-1.png"})
    assert [list(moments) for moments in found.values()] == [["image 1"], ["image 1"]]
    write(tmp_path / "cam-1b.png")
    found = find_photos(tmp_path, patterns={"cam-0": "cam-0.png", "cam-1": "cam-1*.png"})
    assert found["cam-0"].keys() == {0} != found["cam-1"].keys()


def test_patterns_say_it_outright(tmp_path):
    for name in ("1_L", "2_L", "1_R", "2_R"):
        write(tmp_path / f"{name}.png")
    photos = find_photos(tmp_path, patterns={"l": "*_L.png", "r": "*_R.png"})
    assert {n: list(m) for n, m in photos.items()} == {"l": [1, 2], "r": [1, 2]}
    with pytest.raises(ValueError, match=r"q: .*\*_Q\.png"):
        find_photos(tmp_path, patterns={"q": "*_Q.png"})
    with pytest.raises(ValueError, match=r"1_R\.png"):
        find_photos(tmp_path, patterns={"l": "*.png", "r": "*_R.png"})
    with pytest.raises(ValueError, match=r"1_L\.png"):
        find_photos(tmp_path, patterns={"l": f"{tmp_path}/1_L.png"})


def test_videos_are_read_frame_by_frame(tmp_path):
    for name, count in (("a", 165), ("b", 158)):
        video = cv2.VideoWriter(str(tmp_path / f"{name}.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 30, (64, 48))
        for i in range(count):
            video.write(np.full((48, 64, 3), i, np.uint8))
        video.release()
    photos = find_photos(tmp_path)
    assert list(photos) == ["a", "b"]
    assert len(set(photos["a"]) & set(photos["b"])) >= 39
    assert max(len(m) for m in photos.values()) <= 80
    assert photos["a"][64].label == "a.avi frame 64"
    grey = cv2.cvtColor(photos["a"][64].decode(), cv2.COLOR_BGR2GRAY)
    assert abs(float(grey.mean()) - 64) < 2


@pytest.mark.parametrize(
    ("files", "message"), [([], "images"), (["a/x01.png", "a/x1.png", "a/y.txt"], "a: ")]
)
def test_mistakes(files, message, tmp_path):
    for file in files:
        write(tmp_path / file) if file.endswith("png") else (tmp_path / file).write_text("")
    with pytest.raises(ValueError, match=message):
        find_photos(tmp_path)


def test_missing_folders_and_broken_images(tmp_path):
    with pytest.raises(FileNotFoundError, match="none"):
        find_photos(tmp_path / "none")
    for i, content in ((1, b"not an image"), (2, b"")):  # as a camera's file is when it is made
        (tmp_path / f"a{i}.png").write_bytes(content)
    for i in (1, 2):
        with pytest.raises(ValueError, match=rf"a{i}\.png"):
            find_photos(tmp_path)["a"][i].read()
    (tmp_path / "films" / "v").mkdir(parents=True)
    (tmp_path / "films" / "v" / "x.mp4").write_bytes(b"not a video")
    with pytest.raises(ValueError, match=r"x\.mp4"):
        find_photos(tmp_path / "films")


@pytest.mark.parametrize("suffix", ["png", "tif", "webp"])
def test_orientation_tags_are_applied_and_have_to_be_the_same(suffix, tmp_path):
    pixels = np.arange(24, dtype=np.uint8).reshape(4, 6) * 10
    for i, orientation in enumerate((6, 6, 3)):
        exif = Image.Exif()
        exif[274] = orientation
        Image.fromarray(pixels).save(tmp_path / f"cam_{i}.{suffix}", exif=exif, lossless=True)
    with pytest.raises(ValueError, match=r"cam.*cam_0"):
        find_photos(tmp_path)
    (tmp_path / f"cam_2.{suffix}").unlink()
    photo = find_photos(tmp_path)["cam"][0]
    assert (np.atleast_3d(photo.decode())[..., 0] == np.rot90(pixels, -1)).all()


def test_a_photograph_that_states_too_many_pixels_is_not_decoded(tmp_path):
    """A head of 30000 x 30000 pixels: refused by what it states, although OpenCV would try."""
    parts = [
        (b"IHDR", struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(bytes(100))),
    ]
    chunks = [
        struct.pack(">I", len(d)) + kind + d + struct.pack(">I", zlib.crc32(kind + d)) for kind, d in parts
    ]
    for i in range(2):
        (tmp_path / f"a0{i}.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    with pytest.raises(ValueError, match=r"a00\.png.*900000000"):
        find_photos(tmp_path)


@pytest.mark.parametrize("kind", [np.uint16, np.int16, np.int32, np.float32, np.float64])
@pytest.mark.parametrize("bands", [1, 3])
def test_values_of_any_kind_are_stretched_to_grey(kind, bands, tmp_path):
    """Temperatures in one band, as thermal cameras save them, are read."""
    values = np.add.outer(20 * np.arange(48), np.zeros((64, bands))).astype(kind)
    if kind in (np.float32, np.float64):
        values = 20 + values / 4000
        values[0, :8] = np.nan
    tifffile.imwrite(tmp_path / "1.tif", values.squeeze(), photometric="rgb" if bands == 3 else "minisblack")
    (photo,) = find_photos(tmp_path)["camera"].values()
    grey = photo.read()
    assert (grey[0].max(), grey[-1].min()) == (0, 255)
    assert (np.diff(grey[:, -1].astype(int)) >= 0).all()
