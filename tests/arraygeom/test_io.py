"""Readers on hand-written files, writers, and files that are damaged."""

import contextlib
import json
import math
import re
import shutil
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from arraygeom import Camera, LensView, Link, Pose, Rig, View, intrinsics
from arraygeom.distortion import Distortion
from arraygeom.io import READERS, RigFileError, RigFileWarning, convention, read_rig, recognise, write_rig
from arraygeom.pose import rotation_from_vector
from arraygeom.sensor import Sensor
from tests.oracles import Oracle

scipy_io = Oracle("scipy.io")

FIXTURES = Path(__file__).parent / "fixtures"
SIZE = {"hw": (480, 640)}
# File, format, names of the two cameras, and what has to be said when reading.
PAIRS = [
    ("opencv_stereo", "opencv", ("left", "right"), SIZE),
    ("opencv_stereo/intrinsics.yml", "opencv", ("left", "right"), SIZE),
    ("opencv_stereo/extrinsics.yml", "opencv", ("left", "right"), SIZE),
    ("colmap", "colmap", ("a/0001.png", "b/0001.png"), {}),
    ("colmap/images.txt", "colmap", ("a/0001.png", "b/0001.png"), {}),
    ("colmap_rig", "colmap", ("a", "b"), {}),
    ("kalibr.yaml", "kalibr", ("cam0", "cam1"), {}),
    ("matlab_old.json", "matlab", ("camera1", "camera2"), {}),
    ("matlab_new.json", "matlab", ("camera1", "camera2"), {}),
    ("calib_cam_to_cam.txt", "kitti-raw", ("cam0", "cam1"), {}),
    ("transforms.json", "nerfstudio", ("a.png", "b.png"), {}),
    ("multical.json", "multical", ("a", "b"), {}),
    ("aniposelib.toml", "aniposelib", ("a", "b"), {}),
    ("caliscope.toml", "aniposelib", ("cam0", "cam1"), {}),
    ("ros", "ros", ("a", "b"), {}),
    ("boofcv.yaml", "boofcv", ("left", "right"), {}),
    ("pycalib.json", "pycalib", ("cam0", "cam1"), SIZE),
]
POINT = torch.tensor([-0.782, -0.22, 1.876], dtype=torch.float64)
PIXEL_A = [319.5 - 391 / 1.876, 239.5 - 112.2 / 1.876]
PIXEL_B = [389.35, 204.8045]


def assert_is_the_pair(rig: Rig, names: tuple[str, str]) -> None:
    """The pair of fixtures/README.md, whose world is camera a."""
    assert rig.names == names
    a, b = (rig[name] for name in names)
    for camera, pixel, depth in ((a, PIXEL_A, 1.876), (b, PIXEL_B, 2.0)):
        projected = camera.project(POINT)
        assert bool(projected.valid)
        assert projected.x.tolist() == pytest.approx(pixel, abs=1e-11)
        assert float(projected.depth) == pytest.approx(depth, abs=1e-14)
        assert camera.hw == (480, 640)
    assert b.centre.tolist() == pytest.approx([0.098, -0.02, 0.036], abs=1e-14)


@pytest.mark.parametrize(("file", "format", "names", "options"), PAIRS, ids=[p[0] for p in PAIRS])
def test_hand_written_pairs(file, format, names, options):
    assert recognise(FIXTURES / file) == format
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rig = read_rig(FIXTURES / file, **options)
    assert_is_the_pair(rig, names)
    assert_is_the_pair(read_rig(FIXTURES / file, format=format, **options), names)


@pytest.mark.parametrize("file", ["opencv_mono.xml", "opencv_mono.json", "ros/right.yaml"])
def test_single_cameras(file):
    rig = read_rig(FIXTURES / file)
    (camera,) = rig.cameras.values()
    x = camera.project_local(torch.tensor([0.4, -0.2, 2.0], dtype=torch.float64)).x
    assert x.tolist() == pytest.approx(PIXEL_B, abs=1e-11)
    assert camera.hw == (480, 640)


def test_kitti_rectified():
    """P1 = K [I | t] with t = (-0.5, 0.01, 0.02): -338 = -0.5 * 700 + 0.02 * 600, 10.4 = 0.01 * 700 + 0.02 * 170."""
    for file, options in (("kitti_calib.txt", {"hw": (370, 1240)}), ("calib_cam_to_cam.txt", {"format": "kitti"})):
        rig = read_rig(FIXTURES / file, **options)
        assert rig.names == ("cam0", "cam1")
        assert rig["cam0"].t.tolist() == [0, 0, 0]
        assert rig["cam1"].t.tolist() == pytest.approx([-0.5, 0.01, 0.02], abs=1e-15)
        assert rig["cam1"].hw == (370, 1240)


def test_middlebury():
    """Disparity 60 is at 0.2 * 1000 / (60 + 40) = 2 m; vmin 10 and vmax 160 bound 4 m and 1 m."""
    rig = read_rig(FIXTURES / "middlebury.txt")
    X = torch.tensor([0.1, 0.05, 2.0], dtype=torch.float64)
    assert rig["cam0"].project(X).x.tolist() == [550, 325]
    assert rig["cam1"].project(X).x.tolist() == pytest.approx([490, 325])
    assert [float(d) for d in rig.depth] == pytest.approx([1.0, 4.0])
    assert rig["cam1"].hw == (600, 1024)


def test_syntim():
    """No distortion: b sees the point at 310.25 + 400 * 0.2, 244.75 - 404 * 0.1."""
    for file in ("cam_syntim_g", "cam_syntim_d"):
        rig = read_rig(FIXTURES / file)
        assert rig["left"].project(POINT).x.tolist() == pytest.approx(PIXEL_A, abs=1e-11)
        assert rig["right"].project(POINT).x.tolist() == pytest.approx([390.25, 204.35], abs=1e-11)


@pytest.mark.parametrize(
    ("file", "format", "names"),
    [("strecha", "strecha", ("a.png", "b.png")), ("open3d.json", "open3d", ("cam0", "cam1"))],
)
def test_pinhole_pairs(file, format, names):
    """The pair without b's lens."""
    assert recognise(FIXTURES / file) == format
    rig = read_rig(FIXTURES / file)
    assert rig.names == names
    assert rig[names[0]].project(POINT).x.tolist() == pytest.approx(PIXEL_A, abs=1e-11)
    assert rig[names[1]].project(POINT).x.tolist() == pytest.approx([390.25, 204.35], abs=1e-11)
    assert rig[names[1]].centre.tolist() == pytest.approx([0.098, -0.02, 0.036], abs=1e-14)


def test_a_strecha_camera_with_a_lens_is_refused(tmp_path):
    text = (FIXTURES / "strecha" / "b.png.camera").read_text()
    (tmp_path / "b.camera").write_text(text.replace("\n0 0 0\n", "\n-0.1 0 0\n", 1))
    with pytest.raises(RigFileError, match=r"line 4: is .*undistort the images"):
        read_rig(tmp_path / "b.camera")


def test_a_ros_camera_whose_projection_is_zero_stands_at_the_origin(tmp_path):
    text = (FIXTURES / "ros" / "right.yaml").read_text()
    head, _, tail = text.partition("projection_matrix:")
    zeros = re.sub(r"data: \[.*?\]", f"data: {[0.0] * 12}", tail, count=1, flags=re.S)
    (tmp_path / "right.yaml").write_text(f"{head}projection_matrix:{zeros}")
    camera = read_rig(tmp_path / "right.yaml")["b"]
    assert camera.t.tolist() == [0, 0, 0]
    assert camera.R.tolist() == read_rig(FIXTURES / "ros" / "right.yaml")["b"].R.tolist()


def test_colmap_binary(tmp_path):
    q = [0.9486832980505138, 0, 0.31622776601683794, 0, -0.1, 0.02, 0.03]
    cameras = struct.pack("<QIiQQ4d", 2, 1, 1, 640, 480, 500, 510, 320, 240)
    cameras += struct.pack("<IiQQ8d", 7, 4, 640, 480, 400, 404, 310.75, 245.25, -0.2, 0.1, 0.001, -0.002)
    images = struct.pack("<QI7dI", 2, 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a/0001.png\0"
    images += struct.pack("<QddQ", 1, 111.5, 180.2, 1)
    images += struct.pack("<I7dI", 2, *q, 7) + b"b/0001.png\0" + struct.pack("<Q", 0)
    (tmp_path / "cameras.bin").write_bytes(cameras)
    (tmp_path / "images.bin").write_bytes(images)
    assert_is_the_pair(read_rig(tmp_path), ("a/0001.png", "b/0001.png"))
    (tmp_path / "rigs.bin").write_bytes(struct.pack("<QIIiIiIB7d", 1, 1, 2, 0, 1, 0, 7, 1, *q))
    assert_is_the_pair(read_rig(tmp_path), ("a", "b"))
    (tmp_path / "images.bin").write_bytes(images[:-20])
    with pytest.raises(RigFileError, match=r"images\.bin: byte \d+: .*cut off"):
        read_rig(tmp_path)


@pytest.mark.parametrize("file", ["matlab_old.json", "matlab_new.json"])
def test_matlab_mat_files(file, tmp_path):
    fields = json.loads((FIXTURES / file).read_text())

    def arrays(value):
        if isinstance(value, dict):
            return {k: arrays(v) for k, v in value.items()}
        return np.array(value, dtype=float) if isinstance(value, list) else value

    path = tmp_path / "stereo.mat"
    scipy_io.savemat(path, {"s": arrays(fields)})
    assert recognise(path) == "matlab"
    assert_is_the_pair(read_rig(path), ("camera1", "camera2"))
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(RigFileError, match=r"stereo\.mat: .*cut off"):
        read_rig(path)


def test_matlab_fundamental_matrix_has_to_agree(tmp_path):
    """F of pixels from 1, x2^T F x1 = 0; a transposed rotation contradicts it."""
    fields = json.loads((FIXTURES / "matlab_old.json").read_text())
    K1, K2 = (np.array(fields[f"CameraParameters{i}"]["IntrinsicMatrix"]).T for i in (1, 2))
    R, (x, y, z) = np.array(fields["RotationOfCamera2"]).T, fields["TranslationOfCamera2"]
    E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R
    fields["FundamentalMatrix"] = (np.linalg.inv(K2).T @ E @ np.linalg.inv(K1)).tolist()
    path = tmp_path / "stereo.json"
    path.write_text(json.dumps(fields))
    assert_is_the_pair(read_rig(path), ("camera1", "camera2"))
    path.write_text(json.dumps(fields | {"RotationOfCamera2": R.tolist()}))
    with pytest.raises(RigFileError, match=r"FundamentalMatrix: contradicts .* transposed"):
        read_rig(path)


def test_conventions_are_stated():
    for format, reader in READERS.items():
        assert re.search(r"shift|first_pixel", convention(format))
        if format not in ("native", "kitti-raw"):
            assert "Source convention" in reader.__doc__


# Writers ----------------------------------------------------------------------------------------------------


def camera(seed: int, lens: Distortion | None = None, hw: tuple[int, int] = (480, 640), **fields) -> Camera:
    generator = torch.Generator().manual_seed(seed)
    u = torch.rand(10, dtype=torch.float64, generator=generator)
    K = torch.tensor([[400 + u[0], 0, 320 + u[1]], [0, 410 + u[2], 240 - u[3]], [0, 0, 1]], dtype=torch.float64)
    pose = Pose(rotation_from_vector(6 * u[4:7] - 3), u[7:10] / 3)
    return Camera(K=K, cam_from_world=pose, hw=hw, distortion=lens, **fields)


def lens(model: str, *coefficients: float) -> Distortion:
    return Distortion(model, torch.tensor(coefficients, dtype=torch.float64) / 3)


LENSES = [
    None,
    lens("brown-conrady", -0.1, 0.02, 0.001, 0.002),
    lens("kannala-brandt", 0.1, -0.02, 0.003, 0.001),
    lens("brown-conrady", -0.1, 0.02, 0.001, 0.002, 0.01),
    lens("brown-conrady", -0.1, 0.02, 0.001, 0.002, 0.01, 0.03, 0.02, 0.01),
    lens("brown-conrady", *[0.01] * 14),
]
HOLDS = {"native": 6, "colmap": 5, "nerfstudio": 4, "kalibr": 3}


def assert_same(a: Camera, b: Camera) -> None:
    """Equal to 1e-12, but for trailing zeros among the coefficients."""
    for one, two in ((a.K, b.K), (a.R, b.R), (a.t, b.t)):
        torch.testing.assert_close(one, two, rtol=0, atol=1e-12 * max(1.0, float(one.abs().max())))
    assert a.hw == b.hw
    assert (a.distortion is None) == (b.distortion is None)
    if a.distortion is not None:
        assert a.distortion.model == b.distortion.model
        c, d = (torch.nn.functional.pad(x.distortion.coefficients, (0, 14))[:14] for x in (a, b))
        torch.testing.assert_close(c, d, rtol=0, atol=1e-15)


@pytest.mark.parametrize("format", HOLDS)
def test_write_then_read(format, tmp_path):
    kinds = LENSES[: HOLDS[format]]
    rig = Rig({f"view {i}": camera(i, kind, (480 + i, 640)) for i, kind in enumerate(kinds)})
    path = tmp_path / {"native": "rig.yaml", "colmap": "model", "nerfstudio": "t.json", "kalibr": "chain.yaml"}[format]
    write_rig(rig, path, format=format)
    assert recognise(path) == format
    again = read_rig(path)
    assert len(again.names) == len(rig.names)
    if format != "kalibr":
        assert again.names == rig.names
    for one, two in zip(rig.cameras.values(), again.cameras.values()):
        assert_same(one, two)


@pytest.mark.parametrize("kind", LENSES, ids=["none", "4", "fisheye", "5", "8", "14"])
def test_write_then_read_opencv(kind, tmp_path):
    one = camera(1, kind).replace(cam_from_world=Pose.identity())
    write_rig(Rig({"mono": one}), tmp_path / "mono.yml", format="opencv")
    assert_same(one, read_rig(tmp_path / "mono.yml")["mono"])
    pair = Rig({"mono": one, "colour": camera(2, LENSES[1], (400, 500))})
    write_rig(pair, tmp_path / "pair", format="opencv")
    again = read_rig(tmp_path / "pair")
    assert again.names == pair.names
    for name in pair.names:
        assert_same(pair[name], again[name])


def test_kalibr_keeps_time_offsets_and_a_world_at_camera_0(tmp_path):
    zero = camera(1).replace(cam_from_world=Pose.identity())
    rig = Rig({"a": zero, "b": camera(2, sensor=Sensor(time_offset=0.25))})
    write_rig(rig, tmp_path / "chain.yaml", format="kalibr")
    assert "imu:" not in (tmp_path / "chain.yaml").read_text().replace("timeshift_cam_imu", "")
    again = read_rig(tmp_path / "chain.yaml")
    assert again["cam1"].sensor.time_offset == 0.25
    assert_same(rig["b"], again["cam1"])


def test_quaternions_of_rotations_by_180_degrees(tmp_path):
    """Rotations by 180 degrees, where the scalar is 0 and any of the others may be the largest."""
    axes = torch.eye(3, dtype=torch.float64)
    turns = [camera(i).replace(cam_from_world=Pose(2 * a[:, None] * a - axes, a)) for i, a in enumerate(axes)]
    rig = Rig({str(i): c for i, c in enumerate(turns)})
    write_rig(rig, tmp_path, format="colmap")
    for name, one in read_rig(tmp_path).cameras.items():
        assert_same(rig[name], one)


def test_what_a_format_cannot_hold_is_refused(tmp_path):
    path, tilted = tmp_path / "x", camera(1, LENSES[5])
    three = Rig({str(i): camera(i) for i in range(3)})
    with pytest.raises(ValueError, match="one camera or two and the rig has 3"):
        write_rig(three, path, format="opencv")
    with pytest.raises(ValueError, match="'t' has a brown-conrady lens of 14 coefficients"):
        write_rig(Rig({"t": tilted}), path, format="colmap")
    with pytest.raises(ValueError, match="'t' has a skewed or rotated K"):
        write_rig(Rig({"t": camera(1).rot90(1)}), path, format="nerfstudio")
    with pytest.raises(ValueError, match="'u' is not one: use the native format"):
        write_rig(Rig({"u": View(hw=(4, 5))}), path, format="kalibr")
    with pytest.raises(ValueError, match="cannot write rig format 'kitti'"):
        write_rig(three, path, format="kitti")
    assert not path.exists()


# Bad input --------------------------------------------------------------------------------------------------

TEXTS = sorted(
    f for f in FIXTURES.rglob("*") if f.is_file() and f.name not in ("README.md", "frames.txt", "points3D.txt")
)
IDS = [str(f.relative_to(FIXTURES)) for f in TEXTS]


def copied(file: Path, folder: Path, text: str | bytes) -> Path:
    """The file with another text, in a copy of its folder (others of its rig are there too)."""
    home = folder / "rig"
    shutil.rmtree(home, ignore_errors=True)
    if file.parent == FIXTURES:
        home.mkdir()
        for beside in FIXTURES.glob("cam_syntim_*"):
            shutil.copy(beside, home)
    else:
        shutil.copytree(file.parent, home)
    path = home / file.name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def refusal(path: Path, format: str | None = None) -> str:
    """The message of the error that reading gives, one line that names the file, without its folder."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RigFileWarning)
        with pytest.raises(RigFileError) as caught:
            read_rig(path, format=format)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path.parent) in message
    return message.replace(str(path.parent), "")


class NotRefused(Exception):
    """A file was read."""


def message_of(path: Path, format: str) -> str:
    try:
        read_rig(path, format=format)
    except RigFileError as error:
        return str(error)
    raise NotRefused


def formats(file: Path) -> str:
    return recognise(file)


@pytest.mark.parametrize("file", TEXTS, ids=IDS)
def test_truncated_files(file, tmp_path):
    """Cut anywhere: an error in one line, or a rig if what is left is a whole file; never another exception."""
    text, format, messages = file.read_bytes(), formats(file), []
    for cut in np.linspace(0, len(text) - 1, 25).astype(int):
        path = copied(file, tmp_path, text[:cut])
        with warnings.catch_warnings(), contextlib.suppress(NotRefused):
            warnings.simplefilter("ignore", RigFileWarning)
            messages.append(message_of(path, format))
    assert len(messages) >= 10
    assert not any("\n" in message or "cannot be read as" in message for message in messages)


@pytest.mark.parametrize("file", TEXTS, ids=IDS)
def test_empty_files(file, tmp_path):
    format = formats(file)
    assert refusal(copied(file, tmp_path, ""), format).endswith("is empty")
    assert refusal(copied(file, tmp_path, " \n\n"), format).endswith("is empty")


@pytest.mark.parametrize("format", [f for f in READERS if f != "colmap"])
def test_wrong_formats(format, tmp_path):
    """Every reader, told to read the others' files, and files that are no text or no rig at all."""
    others = [f for f in TEXTS if formats(f) != format and f.parent == FIXTURES]
    assert len(others) > 10
    for file in others:
        if {formats(file), format} in ({"kitti", "kitti-raw"}, {"aniposelib", "caliscope"}):
            continue
        refusal(copied(file, tmp_path, file.read_bytes()), format)
    for content in (b"\xff\xd8\xff\xe0" + bytes(range(256)), b"hello", b"[1, 2, 3]", b"{}", b"a: 1\n"):
        path = tmp_path / "rig.dat"
        path.write_bytes(content)
        refusal(path, format)


def test_unknown_files(tmp_path):
    path = tmp_path / "rig.dat"
    path.write_text("hello")
    assert "not a rig file of a known format" in refusal(path)
    path.write_text("")
    assert refusal(path).endswith("is empty")
    assert "not a rig file" in refusal_of_folder(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"nowhere\.yaml: no such rig file"):
        read_rig(tmp_path / "nowhere.yaml")
    with pytest.raises(ValueError, match="unknown rig format 'x'"):
        read_rig(path, format="x")


def refusal_of_folder(folder: Path) -> str:
    with pytest.raises(RigFileError) as caught:
        read_rig(folder)
    return str(caught.value)


# In every file: camera b's focal length, its name in the messages, and its rotation's or quaternion's first number.
FOCAL = {"cam_syntim_g": "500.000000", "kitti_calib.txt": "7.000000000000e+02", "middlebury.txt": "1000"}
FOCAL |= {
    "extrinsics.yml": "",
    "images.txt": "",
    "rigs.txt": "",
    "left.yaml": "500.0",
    "a.png.camera": "500",
    "opencv_stereo": "400.",
    "metashape.xml": "500",
    "matlab_fisheye.json": "300.0",
}
WITH_FOCAL = [f for f in TEXTS if FOCAL.get(f.name, "400")]


def focal_pattern(file: Path) -> str:
    number = FOCAL.get(file.name, "400")
    return rf"(?<![\d.]){re.escape(number)}(\.0*)?(?![\d.])"


@pytest.mark.parametrize("file", WITH_FOCAL, ids=[str(f.relative_to(FIXTURES)) for f in WITH_FOCAL])
@pytest.mark.parametrize(("value", "cause"), [("nan", "NaN"), ("0.0", "focal"), ("-400.0", "focal")])
def test_focal_lengths(file, value, cause, tmp_path):
    if value == "nan":
        value = {".json": "NaN", ".yaml": ".nan", ".yml": ".Nan", ".xml": ".Nan"}.get(file.suffix, "nan")
        value = "nan" if file.name == "metashape.xml" else value
        if file.name == "opencv_mono.json":
            pytest.skip("OpenCV's JSON has no NaN")
    text, count = re.subn(focal_pattern(file), value, file.read_text(), count=1)
    assert count == 1
    message = refusal(copied(file, tmp_path, text), formats(file))
    assert cause in message, message


NOT_ROTATIONS = {
    "opencv_stereo/extrinsics.yml": ("0.8, 0., 0.6", "0.8, 0., 0.7"),
    "colmap/images.txt": ("0.9486832980505138", "0.8486832980505138"),
    "colmap_rig/rigs.txt": ("0.9486832980505138", "0.8486832980505138"),
    "kalibr.yaml": ("[0.8, 0.0, 0.6,", "[0.8, 0.0, 0.7,"),
    "matlab_old.json": ("[[0.8, 0, -0.6]", "[[0.8, 0, -0.7]"),
    "matlab_new.json": ("[[0.8, 0, 0.6]", "[[0.8, 0, 0.7]"),
    "calib_cam_to_cam.txt": ("R_01: 0.8", "R_01: 0.9"),
    "transforms.json": ("[[0.8, 0, 0.6,", "[[0.8, 0, 0.7,"),
    "multical.json": ("[[0.8, 0.0, 0.6]", "[[0.8, 0.0, 0.7]"),
    "caliscope.toml": ("[[0.8, 0.0, 0.6]", "[[0.8, 0.0, 0.7]"),
    "ros/right.yaml": ("[0.8, 0.0, -0.6,", "[0.8, 0.0, -0.7,"),
    "cam_syntim_d": ("{{0.800000,", "{{0.900000,"),
    "boofcv.yaml": ("[0.8, 0.0, -0.6,", "[0.8, 0.0, -0.7,"),
    "pycalib.json": ("[[0.8, 0, 0.6]", "[[0.8, 0, 0.7]"),
    "metashape.xml": ("0.8 0 0.6 0.05", "0.8 0 0.7 0.05"),
}


@pytest.mark.parametrize(("name", "change"), NOT_ROTATIONS.items(), ids=list(NOT_ROTATIONS))
def test_rotations(name, change, tmp_path):
    file = FIXTURES / name
    text = file.read_text()
    assert text.count(change[0]) == 1
    message = refusal(copied(file, tmp_path, text.replace(*change)), formats(file))
    assert "not a rotation" in message or "quaternion of length" in message, message


def test_reflections_and_rounded_rotations(tmp_path):
    file = FIXTURES / "kalibr.yaml"
    text = file.read_text()
    mirrored = text.replace("[0.0, 1.0, 0.0, 0.02]", "[0.0, -1.0, 0.0, 0.02]")
    assert "is a reflection" in refusal(copied(file, tmp_path, mirrored))
    rounded = copied(file, tmp_path, text.replace("[0.8, 0.0, 0.6,", "[0.8001, 0.0, 0.6,"))
    R = read_rig(rounded)["cam1"].R
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-14)


DUPLICATES = {
    "colmap/cameras.txt": ("\n7 OPENCV", "\n1 OPENCV"),
    "colmap/images.txt": ("b/0001.png", "a/0001.png"),
    "kalibr.yaml": ("cam1:", "cam0:"),
    "transforms.json": ("b.png", "a.png"),
    "multical.json": ('"b": {', '"a": {'),
    "aniposelib.toml": ('"b"', '"a"'),
    "caliscope.toml": ("[cameras.1]", "[cameras.0]"),
    "kitti_calib.txt": ("P1:", "P0:"),
    "calib_cam_to_cam.txt": ("K_01:", "K_00:"),
    "middlebury.txt": ("cam1=", "cam0="),
    "ros/right.yaml": ("camera_name: b", "camera_name: a"),
    "metashape.xml": ("b.jpg", "a.jpg"),
}


@pytest.mark.parametrize(("name", "change"), DUPLICATES.items(), ids=list(DUPLICATES))
def test_duplicate_cameras(name, change, tmp_path):
    file = FIXTURES / name
    path = copied(file, tmp_path, file.read_text().replace(*change))
    if name.startswith("ros"):
        assert "occurs twice" in refusal_of_folder(path.parent)
    else:
        message = refusal(path, formats(file))
        assert "twice" in message or "overwrite" in message or "declare" in message, message


def test_wrong_units_warn(tmp_path):
    file = FIXTURES / "kalibr.yaml"
    path = copied(file, tmp_path, file.read_text().replace("0.6, -0.1]", "0.6, -100.0]"))
    with pytest.warns(RigFileWarning, match="cameras 100 m apart: is this file in millimetres.*units: millimetres"):
        read_rig(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rig = read_rig(path, scale=1e-3)
    assert math.isclose(float(rig["cam1"].t[0]), -0.1)
    file = FIXTURES / "middlebury.txt"
    path = copied(file, tmp_path, file.read_text().replace("baseline=200", "baseline=0.05"))
    with pytest.warns(RigFileWarning, match="is this file in metres, and read as millimetres"):
        read_rig(path)


def test_unstated_sizes_warn():
    with pytest.warns(RigFileWarning, match=r"states no image size: took 1201 x 341, .* say `hw"):
        assert read_rig(FIXTURES / "kitti_calib.txt")["cam1"].hw == (341, 1201)


def test_what_is_not_supported_says_so(tmp_path):
    for name, old, new, words in (
        ("kalibr.yaml", "radtan", "wide", "cam1.distortion_model: is 'wide'; supported for pinhole: radtan"),
        ("kalibr.yaml", "camera_model: pinhole", "camera_model: tele", "camera_model: is 'tele'; supported: pinhole"),
        ("kalibr.yaml", "cam1:", "cam2:", "the chain has a gap"),
        ("colmap/cameras.txt", "PINHOLE", "WIDE", "line 4: has model WIDE, which is not read: calibrate with one of"),
        ("colmap/cameras.txt", "\n7 OPENCV", "\n8 OPENCV", "camera 7: is used by an image or a rig and not defined"),
        ("transforms.json", '"OPENCV"', '"EQUIRECTANGULAR"', "camera_model: is EQUIRECTANGULAR; supported"),
        ("middlebury.txt", "doffs=40", "doffs=-40", "doffs: is -40, which is not the difference"),
        ("ros/left.yaml", "plumb_bob", "omni", "distortion_model: is 'omni'; supported"),
        ("multical.json", "b_to_a", "c_to_a", "camera_poses.c_to_a: names no camera"),
        ("matlab_old.json", '"CameraParameters1"', '"Camera1"', "CameraParameters1: is missing"),
    ):
        file = FIXTURES / name
        message = refusal(copied(file, tmp_path, file.read_text().replace(old, new)), formats(file))
        assert words in message, message


def test_colmap_models_that_lost_entries(tmp_path):
    """COLMAP's comment says how many images there are: a file cut between two of them is not a whole one."""
    file = FIXTURES / "colmap" / "images.txt"
    lines = file.read_text().splitlines(keepends=True)
    message = refusal(copied(file, tmp_path, "".join(lines[:6])), "colmap")
    assert message.endswith("announces 2 images and holds 1; was it cut off?")


def test_what_cameras_record_comes_back(tmp_path):
    raw = Sensor(
        response="rgb", coding="linear", bayer="GBRG", bits=12, black_level=64.0, exposure=0.0018, gain=(1.9, 1.0, 1.4)
    )
    slow = Sensor(frame_rate=30.0, time_offset=-0.004, gain=2.5)
    rig = Rig({"raw": View(hw=(4, 6), sensor=raw), "slow": View(hw=(4, 6), sensor=slow)})
    rig.save(tmp_path / "rig.yaml")
    again = Rig.load(tmp_path / "rig.yaml")
    assert [again[name].sensor for name in again.names] == [raw, slow]


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("bayer: RGBG", r"cameras.a.bayer: .*'RGBG'; wanted 'RGGB' or"),
        ("coding: gamma", "wanted 'srgb' or 'linear'"),
        ("bits: 12.5", "wanted a whole number from 1 to 16"),
        ("black_level: 64", "needs 'bits'"),
        ("bits: 6, black_level: 64", "not between 0 and white"),
        ("exposure: 0", "wanted a number above 0"),
        ("gain: [1, 2]", "3 numbers"),
        ("gain: [1, 2, -1]", "gains are positive"),
        ("frame_rate: fast", "a number"),
    ],
)
def test_wrong_facts_of_a_sensor_are_named(tmp_path, entry, message):
    (tmp_path / "rig.yaml").write_text("cameras:\n  a: {size: [6, 4], " + entry + "}\n")
    with pytest.raises(RigFileError, match=message):
        Rig.load(tmp_path / "rig.yaml")


def test_rotation_vectors_are_in_degrees(tmp_path):
    (tmp_path / "rig.yaml").write_text("cameras:\n  a: {size: [6, 4], focal: 5, rotation: [0, 0, 90]}\n")
    expected = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(Rig.load(tmp_path / "rig.yaml")["a"].R, expected)


def test_a_size_that_is_missing_is_called_missing(tmp_path):
    (tmp_path / "rig.yaml").write_text("format: arraygeom-rig 1\ncameras: {mono: {focal: 800}}\n")
    with pytest.raises(RigFileError, match=r"cameras\.mono\.size: is missing"):
        Rig.load(tmp_path / "rig.yaml")


def test_an_image_upside_down_survives_the_native_file(tmp_path):
    """Its K has negative focal lengths, which `focal` cannot state."""
    K = intrinsics(300.0, (240, 320))
    rig = Rig({"a": Camera(K=K, cam_from_world=Pose.identity(), hw=(240, 320))}).rot90("a", 2)
    rig.save(tmp_path / "rig.yaml")
    assert torch.equal(Rig.load(tmp_path / "rig.yaml")["a"].K, rig["a"].K)


def test_lenses_of_uncalibrated_cameras_come_back(tmp_path):
    lens = Distortion("brown-conrady", torch.tensor([-0.05, 0.01, 1e-3, -2e-3], dtype=torch.float64))
    views = {
        "a": LensView(hw=(400, 640), K=intrinsics(320.0, (400, 640)), distortion=lens, sensor=Sensor(response="rgb")),
        "b": View(hw=(400, 640)),
    }
    F = torch.tensor([[0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    rig = Rig(views, links={("a", "b"): Link(F)}).resize("a", (300, 480)).rot90("a", 1)
    rig.save(tmp_path / "rig.yaml")
    again = Rig.load(tmp_path / "rig.yaml")
    assert type(again["a"]) is LensView
    assert type(again["b"]) is View
    assert again["a"].sensor == views["a"].sensor
    x = torch.tensor([[10.0, 20.0], [250.0, 470.0]], dtype=torch.float64)
    assert torch.equal(again["a"].undistort(x)[0], rig["a"].undistort(x)[0])
    assert (again["a"].undistort(x)[0] - x).norm(dim=-1).max() > 1
    assert torch.equal(again.links["a", "b"].F, rig.links["a", "b"].F)


def test_a_lens_without_focal_length_states_its_scale(tmp_path):
    path = tmp_path / "rig.yaml"
    text = "first_pixel_centre: 1\ncameras:\n  a:\n    size: [640, 400]\n    distortion: "
    path.write_text(text + "{model: brown-conrady, coefficients: [0.1, 0, 0, 0], scale: 320, centre: [321, 201]}\n")
    view = Rig.load(path)["a"]
    assert isinstance(view, LensView)
    assert not isinstance(view, Camera)
    assert view.distort(torch.tensor([640.0, 200.0], dtype=torch.float64))[0].tolist() == pytest.approx([672, 200])
    path.write_text(text + "{model: brown-conrady, coefficients: [0.1, 0, 0, 0]}\n")
    with pytest.raises(RigFileError, match=r"cameras\.a\.distortion: is of a camera without 'focal'.*`scale`"):
        Rig.load(path)
    path.write_text(text + "{model: brown-conrady, coefficients: [0.1, 0, 0, 0], scale: -3}\n")
    with pytest.raises(RigFileError, match=r"distortion\.scale: is -3; a scale is positive"):
        Rig.load(path)
    path.write_text(
        text.replace("640, 400]", "640, 400]\n    focal: 500") + "{model: x, coefficients: [0], scale: 3}\n"
    )
    with pytest.raises(RigFileError, match=r"distortion\.scale: unknown key"):
        Rig.load(path)
