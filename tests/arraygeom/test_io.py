"""Readers on hand-written files, and writers."""

import json
import math
import re
import struct
import warnings
from inspect import getmodule
from pathlib import Path

import numpy as np
import pytest
import torch

from arraygeom import Camera, LensView, Link, Pose, Rig, View, intrinsics, stack
from arraygeom.distortion import Distortion
from arraygeom.fields import default_field
from arraygeom.io import READERS, WRITERS, RigFileError, matlab, read_rig, recognise, write_rig
from arraygeom.io.source import RigSource
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
    ("multical.json", "usual", ("a", "b"), {}),
    ("aniposelib.toml", "usual", ("a", "b"), {}),
    ("caliscope.toml", "usual", ("cam0", "cam1"), {}),
    ("ros", "ros", ("a", "b"), {}),
    ("boofcv.yaml", "boofcv", ("left", "right"), {}),
    ("luxonis.json", "luxonis", ("CAM_B", "CAM_C"), {}),
    ("mrcal", "mrcal", ("a", "b"), {}),
    ("realsense.txt", "realsense", ("Depth", "Color"), {}),
    ("pycalib.json", "usual", ("cam0", "cam1"), SIZE),
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


@pytest.mark.parametrize("file", sorted({path.name for path in FIXTURES.iterdir()} - {"README.md"}))
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16-le", "utf-16-be"])
def test_files_are_read_behind_a_mark(file, encoding, tmp_path):
    """Editors, and PowerShell for the output of tools, write a byte order mark, and Windows' line ends."""
    for old in [p for p in FIXTURES.rglob("*") if p.is_file()]:
        new = tmp_path / old.relative_to(FIXTURES)
        new.parent.mkdir(exist_ok=True)
        text = "\ufeff" + old.read_text(encoding="utf-8").replace("\n", "\r\n")
        new.write_bytes(text.encode(encoding))
    assert recognise(tmp_path / file) == recognise(FIXTURES / file)
    found, wanted = (read_rig(folder / file, hw=(720, 1280)) for folder in (tmp_path, FIXTURES))
    assert found.names == wanted.names
    for one, other in zip(found.cameras.values(), wanted.cameras.values()):
        assert one == other


@pytest.mark.parametrize("file", ["opencv_mono.xml", "opencv_mono.json", "ros/right.yaml"])
def test_single_cameras(file):
    rig = read_rig(FIXTURES / file)
    (camera,) = rig.cameras.values()
    x = camera.project_local(torch.tensor([0.4, -0.2, 2.0], dtype=torch.float64)).x
    assert x.tolist() == pytest.approx(PIXEL_B, abs=1e-11)
    assert camera.hw == (480, 640)


def test_kitti_rectified():
    """P1 = K [I | t], t = (-.5, .01, .02): -338 = -.5 * 700 + .02 * 600, 10.4 = .01 * 700 + .02 * 170."""
    for file, options in (
        ("kitti_calib.txt", {"hw": (370, 1240)}),
        ("calib_cam_to_cam.txt", {"format": "kitti"}),
    ):
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


@pytest.mark.parametrize("least", [-40, -41])
def test_middlebury_to_infinity(least, tmp_path):
    """Without disparity points are at infinity; the near bound is kept."""
    text = (FIXTURES / "middlebury.txt").read_text()
    (tmp_path / "calib.txt").write_text(re.sub("vmin *= *10", f"vmin={least}", text))
    near, far = read_rig(tmp_path / "calib.txt").depth
    assert float(near) == pytest.approx(1.0)
    assert far == torch.inf


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
    with pytest.raises(RigFileError, match="line 4: "):
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
    with pytest.raises(RigFileError, match=r"images\.bin: "):
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
    with pytest.raises(RigFileError, match=r"stereo\.mat: "):
        read_rig(path)


def test_a_missing_matlab_file_is_named(tmp_path):
    with pytest.raises(RigFileError, match=r"none\.json"):
        matlab.read(RigSource(tmp_path / "none.json"))


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
    with pytest.raises(RigFileError, match="FundamentalMatrix"):
        read_rig(path)


def test_conventions_are_stated():
    for format, reader in READERS.items():
        assert format == "native" or re.search(
            r"\nSource convention: [^\0]*?shift", getmodule(reader).__doc__
        )


# Writers ----------------------------------------------------------------------------------------------------


def camera(seed: int, lens: Distortion | None = None, hw: tuple[int, int] = (480, 640), **fields) -> Camera:
    generator = torch.Generator().manual_seed(seed)
    u = torch.rand(10, dtype=torch.float64, generator=generator)
    K = torch.tensor(
        [[400 + u[0], 0, 320 + u[1]], [0, 410 + u[2], 240 - u[3]], [0, 0, 1]], dtype=torch.float64
    )
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
    path = (
        tmp_path
        / {"native": "rig.yaml", "colmap": "model", "nerfstudio": "t.json", "kalibr": "chain.yaml"}[format]
    )
    write_rig(rig, path, format=format)
    assert recognise(path) == format
    again = read_rig(path)
    assert len(again.names) == len(rig.names)
    if format != "kalibr":
        assert again.names == rig.names
    for one, two in zip(rig.cameras.values(), again.cameras.values()):
        assert_same(one, two)


NAMES = ["a b", "1e3", 'q"', "q'", "back\\slash", "é漢", "sub/im.png", "x: #y", "%p", "true", "1"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("format", ["native", "opencv", "colmap", "nerfstudio"])
def test_odd_names_come_back(format, name, tmp_path):
    rig = Rig({name: camera(1), "other": camera(2)})
    path = tmp_path / {"native": "rig.yaml", "nerfstudio": "t.json"}.get(format, "folder")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        write_rig(rig, path, format=format)
    assert read_rig(path).names == rig.names


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


@pytest.mark.parametrize(
    "name", ["two\nlines", "tab\tbed", "sep\u2028arated", "\x1b[2J", "a\ud800", "\u202eb"]
)
def test_names_that_cannot_be_printed_are_refused(name, tmp_path):
    """They would end a line of a file, or a terminal would do as they say."""
    with pytest.raises(ValueError, match=re.escape(ascii(name))):
        Rig({"a": camera(1), name: camera(2)})
    write_rig(Rig({"a b": camera(1)}), tmp_path / "rig.yaml")
    text = (tmp_path / "rig.yaml").read_text()
    (tmp_path / "rig.yaml").write_text(text.replace("a b", json.dumps(name)))
    with pytest.raises(RigFileError):
        read_rig(tmp_path / "rig.yaml")


def test_what_a_format_cannot_hold_is_refused(tmp_path):
    path, tilted = tmp_path / "x", camera(1, LENSES[5])
    three = Rig({str(i): camera(i) for i in range(3)})
    with pytest.raises(ValueError, match=r"camera.* 3"):
        write_rig(three, path, format="opencv")
    with pytest.raises(ValueError, match=r"'t'.*brown-conrady"):
        write_rig(Rig({"t": tilted}), path, format="colmap")
    with pytest.raises(ValueError, match=r"'t'.* K"):
        write_rig(Rig({"t": camera(1).rot90(1)}), path, format="nerfstudio")
    mirrored = camera(1).transformed(torch.diag(torch.tensor([-1.0, 1, 1])).double(), camera(1).hw)
    for format in set(WRITERS) - {"native"}:
        with pytest.raises(ValueError, match=r"'m'.* mirrored"):
            write_rig(Rig({"m": mirrored}), path, format=format)
    for name in ("", " a", "a "):
        with pytest.raises(ValueError, match="line"):
            write_rig(Rig({name: camera(1)}), path, format="colmap")
    with pytest.raises(ValueError, match="'u'"):
        write_rig(Rig({"u": View(hw=(4, 5))}), path, format="kalibr")
    moving = camera(1).replace(cam_from_world=stack([camera(i).cam_from_world for i in (1, 2)]))
    with pytest.raises(ValueError, match="batch"):
        write_rig(Rig({"m": moving}), path, format="opencv")
    with pytest.raises(ValueError, match="'kitti'"):
        write_rig(three, path, format="kitti")
    assert not path.exists()


def test_what_cameras_record_comes_back(tmp_path):
    raw = Sensor(
        response="rgb",
        coding="linear",
        bayer="GBRG",
        bits=12,
        black_level=64.0,
        exposure=0.0018,
        gain=(1.9, 1.0, 1.4),
    )
    slow = Sensor(frame_rate=30.0, time_offset=-0.004, gain=2.5)
    rig = Rig({"raw": View(hw=(4, 6), sensor=raw), "slow": View(hw=(4, 6), sensor=slow)})
    rig.save(tmp_path / "rig.yaml")
    again = Rig.load(tmp_path / "rig.yaml")
    assert [again[name].sensor for name in again.names] == [raw, slow]


@pytest.mark.parametrize("offset", [math.inf, -math.inf, math.nan])
def test_a_clock_starts_at_a_finite_time(offset):
    with pytest.raises(ValueError, match="time_offset"):
        Sensor(time_offset=offset)
    assert Sensor(time_offset=-0.5).time_offset == -0.5


def test_rotation_vectors_are_in_degrees(tmp_path):
    (tmp_path / "rig.yaml").write_text("cameras:\n  a: {size: [6, 4], focal: 5, rotation: [0, 0, 90]}\n")
    expected = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(Rig.load(tmp_path / "rig.yaml")["a"].R, expected)


def test_an_image_upside_down_survives_the_native_file(tmp_path):
    """Its K has negative focal lengths, which `focal` cannot state."""
    K = intrinsics(300.0, (240, 320))
    rig = Rig({"a": Camera(K=K, cam_from_world=Pose.identity(), hw=(240, 320))}).rot90("a", 2)
    rig.save(tmp_path / "rig.yaml")
    assert torch.equal(Rig.load(tmp_path / "rig.yaml")["a"].K, rig["a"].K)


def test_images_that_a_homography_registers_are_a_rig(tmp_path):
    """A link may have H alone, as two cameras at one place do."""
    H = "H: [[1, 0, 5], [0, 1, 3], [0, 0, 1]]"
    (tmp_path / "rig.yaml").write_text(
        f"cameras: {{a: {{size: [64, 48]}}, b: {{size: [64, 48]}}}}\nlinks: [{{alpha: a, beta: b, {H}}}]\n"
    )
    rig = Rig.load(tmp_path / "rig.yaml")
    rig.save(tmp_path / "again.yaml")
    assert "F:" not in (tmp_path / "again.yaml").read_text()
    for pair in (rig.pair("a", "b"), Rig.load(tmp_path / "again.yaml").pair("a", "b")):
        assert pair.at_one_place
        segments = default_field(pair)(pair, torch.tensor([[20.0, 20.0]]))
        assert (segments.start + segments.end).tolist() == [[50.0, 46.0]], "about H x"
        assert 0 < float(segments.length) < 6, "a few pixels, as H is seldom exact"
    one = Camera(K=intrinsics(50.0, (48, 64)), cam_from_world=Pose.identity(), hw=(48, 64))
    pair = Rig({"a": one, "b": one}).pair("a", "b")
    segments = default_field(pair)(pair, torch.tensor([[20.0, 20.0]]))
    assert (segments.start + segments.end).tolist() == [[40.0, 40.0]]


def test_the_search_about_a_homography_is_as_wide_as_its_points_are_off(tmp_path):
    """Four standard deviations to either side, whatever pixels the images are resized to."""
    H, size = torch.eye(3, dtype=torch.float64), View(hw=(48, 64))
    rig = Rig({"a": size, "b": size}, links={("a", "b"): Link.from_homography(H, spread=1.5)})
    rig.save(tmp_path / "rig.yaml")
    for found in (rig, Rig.load(tmp_path / "rig.yaml")):
        for pair, length in ((found.pair("a", "b"), 12), (found.resize("b", (96, 128)).pair("a", "b"), 24)):
            segments = default_field(pair)(pair, torch.tensor([[20.0, 20.0]]))
            assert float(segments.length) == pytest.approx(length)
    assert rig.links["a", "b"].reversed().spread == pytest.approx(1.5)
    assert rig.resize("b", (96, 128)).links["a", "b"].reversed().spread == pytest.approx(1.5)
    rig.replace(links={("a", "b"): Link(torch.rand(3, 3), H, 1.5)}).save(tmp_path / "lines.yaml")
    assert Rig.load(tmp_path / "lines.yaml").links["a", "b"].spread == 1.5
    (tmp_path / "bad.yaml").write_text((tmp_path / "rig.yaml").read_text().replace("1.5", "-1"))
    with pytest.raises(RigFileError, match="spread"):
        Rig.load(tmp_path / "bad.yaml")


def test_links_name_cameras_that_are_numbers(tmp_path):
    F = "F: [[0, 0, 0], [0, 0, -1], [0, 1, 0]]"
    cameras = "cameras: {0: {size: [640, 400]}, 1: {size: [640, 400]}}"
    text = f"{cameras}\nlinks:\n  - {{alpha: 0, beta: 1, {F}}}\n"
    (tmp_path / "rig.yaml").write_text(text)
    assert set(Rig.load(tmp_path / "rig.yaml").links) == {("0", "1")}
    (tmp_path / "rig.yaml").write_text(text.replace("beta: 1", "beta: 2"))
    with pytest.raises(RigFileError, match=r"beta.*'2'"):
        Rig.load(tmp_path / "rig.yaml")


def test_lenses_of_uncalibrated_cameras_come_back(tmp_path):
    lens = Distortion("brown-conrady", torch.tensor([-0.05, 0.01, 1e-3, -2e-3], dtype=torch.float64))
    views = {
        "a": LensView(
            hw=(400, 640), K=intrinsics(320.0, (400, 640)), distortion=lens, sensor=Sensor(response="rgb")
        ),
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
    lens = "{model: brown-conrady, coefficients: [0.1, 0, 0, 0], scale: 320, centre: [321, 201]}"
    (tmp_path / "rig.yaml").write_text(
        f"first_pixel_centre: 1\ncameras:\n  a:\n    size: [640, 400]\n    distortion: {lens}\n"
    )
    view = Rig.load(tmp_path / "rig.yaml")["a"]
    assert isinstance(view, LensView)
    assert not isinstance(view, Camera)
    x = view.distort(torch.tensor([640.0, 200.0], dtype=torch.float64))[0]
    assert x.tolist() == pytest.approx([672, 200])


def test_opencv_24s_samples_state_their_size(tmp_path):
    """`image_Width` is a stated size."""
    K = "<rows>3</rows><cols>3</cols><dt>d</dt><data>500. 0. 300. 0. 500. 250. 0. 0. 1.</data>"
    D = "<rows>5</rows><cols>1</cols><dt>d</dt><data>0. 0. 0. 0. 0.</data>"
    path = tmp_path / "out.xml"
    path.write_text(
        '<?xml version="1.0"?><opencv_storage><image_Width>640</image_Width><image_Height>480</image_Height>'
        f'<Camera_Matrix type_id="opencv-matrix">{K}</Camera_Matrix>'
        f'<Distortion_Coefficients type_id="opencv-matrix">{D}</Distortion_Coefficients></opencv_storage>'
    )
    (camera,) = Rig.load(path).cameras.values()
    assert camera.hw == (480, 640)
