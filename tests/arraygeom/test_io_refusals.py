"""Rig files that are damaged or wrong: each gives one line that names the file."""

import contextlib
import math
import re
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from arraygeom.io import READERS, RigFileError, RigFileWarning, read_rig, recognise
from arraygeom.io.native import read_text
from tests.oracles import Oracle

scipy_io = Oracle("scipy.io")

FIXTURES = Path(__file__).parent / "fixtures"


def test_text_of_another_encoding_is_said(tmp_path):
    (tmp_path / "rig.yaml").write_bytes("format: arraygeom-rig 1\n# Größe\n".encode("latin-1"))
    with pytest.raises(RigFileError, match=r"rig.yaml.*UTF"):
        read_rig(tmp_path / "rig.yaml")


TEXTS = sorted(
    f
    for f in FIXTURES.rglob("*")
    if f.is_file() and f.name not in ("README.md", "frames.txt", "points3D.txt")
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


@pytest.mark.parametrize("file", TEXTS, ids=IDS)
def test_truncated_files(file, tmp_path):
    """Cut anywhere: an error in one line, or a rig if a whole file is left; never another exception."""
    text, format, messages = file.read_bytes(), recognise(file), []
    for cut in np.linspace(0, len(text) - 1, 25).astype(int):
        path = copied(file, tmp_path, text[:cut])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RigFileWarning)
            try:
                read_rig(path, format=format)
            except RigFileError as error:
                messages.append(str(error))
    assert len(messages) >= 10
    assert not any("\n" in message or "cannot be read as" in message for message in messages)


@pytest.mark.parametrize("file", TEXTS, ids=IDS)
def test_empty_files(file, tmp_path):
    format = recognise(file)
    assert refusal(copied(file, tmp_path, ""), format).endswith("is empty")
    assert refusal(copied(file, tmp_path, " \n\n"), format).endswith("is empty")


@pytest.mark.parametrize("format", [f for f in READERS if f != "colmap"])
def test_wrong_recognise(format, tmp_path):
    """Every reader on the others' files, and on files that are no text or no rig at all."""
    others = [f for f in TEXTS if recognise(f) != format and f.parent == FIXTURES]
    assert len(others) > 10
    for file in others:
        if {recognise(file), format} == {"kitti", "kitti-raw"}:
            continue
        path = copied(file, tmp_path, file.read_bytes())
        if READERS[format] in (READERS["usual"], READERS["opencv"]):  # they read usual names in any file
            with contextlib.suppress(RigFileError):
                read_rig(path, format=format)
            continue
        refusal(path, format)
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
    with pytest.raises(RigFileError, match=r"file[^/]*$"):
        read_rig(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"nowhere\.yaml: "):
        read_rig(tmp_path / "nowhere.yaml")
    with pytest.raises(ValueError, match="'x'"):
        read_rig(path, format="x")


# In every file: camera b's focal length, its name in the messages, and its rotation's or quaternion's first
# number.
FOCAL = {
    "a.cameramodel": "500",
    "cam_syntim_g": "500.000000",
    "kitti_calib.txt": "7.000000000000e+02",
    "middlebury.txt": "1000",
    "extrinsics.yml": "",
    "images.txt": "",
    "rigs.txt": "",
    "left.yaml": "500.0",
    "a.png.camera": "500",
    "opencv_stereo": "400.",
    "metashape.xml": "500",
    "matlab_fisheye.json": "300.0",
    "lensboy.json": "200.0",
    "splined_cubic.cameramodel": "150",
    "splined_quadratic.cameramodel": "200",
    "zed.conf": "698",
    "azure.json": "0.625",
    "extri.yml": "",
}
WITH_FOCAL = [f for f in TEXTS if FOCAL.get(f.name, "400")]


@pytest.mark.parametrize("file", WITH_FOCAL, ids=[str(f.relative_to(FIXTURES)) for f in WITH_FOCAL])
@pytest.mark.parametrize(("value", "cause"), [("nan", "NaN"), ("0.0", "focal"), ("-400.0", "focal")])
def test_focal_lengths(file, value, cause, tmp_path):
    if value == "nan":
        value = {".json": "NaN", ".yaml": ".nan", ".yml": ".Nan", ".xml": ".Nan"}.get(file.suffix, "nan")
        value = {"metashape.xml": "nan"}.get(file.name, "1e999" if file.suffix == ".cameramodel" else value)
        if file.name == "opencv_mono.json":
            pytest.skip("OpenCV's JSON has no NaN")
    number = re.escape(FOCAL.get(file.name, "400"))
    text, count = re.subn(rf"(?<![\d.]){number}(\.0*)?(?![\d.])", value, file.read_text(), count=1)
    assert count == 1
    message = refusal(copied(file, tmp_path, text), recognise(file))
    assert cause in message, message


NO_ROTATION, TWICE = "not a rotation|quaternion of length", "twice|overwrite|declare"
REFUSED = [
    ("luxonis.json", '"toCameraSocket": -1', '"toCameraSocket": 1', "the chain of extrinsics is a circle"),
    ("luxonis.json", '"toCameraSocket": 2,', '"toCameraSocket": 2, "lengthUnit": 0,', "lengthUnit: is 0"),
    ("luxonis.json", '"cameraType": 0', '"cameraType": 2', r"cameraType: is 2; perspective \(0\)"),
    ("luxonis.json", '"toCameraSocket": 2', '"toCameraSocket": -1', "CAM_C: is related to no camera"),
    ("mrcal/b.cameramodel", "OPENCV4", "SPLINED_STEREOGRAPHIC_order=3", "use mrcal-convert-lensmodel"),
    ("splined_cubic.cameramodel", "Nx=7", "Nx=8", "intrinsics: has 88 numbers, wanted 100"),
    ("splined_cubic.cameramodel", "Nx=7_Ny=6", "Nx=42_Ny=1", "lensmodel: knots are .* 4 or more to a side"),
    ("splined_cubic.cameramodel", "x_deg=140", "x_deg=400", "spacing is that of knots"),
    ("lensboy.json", '"4.0.3"', '"2.1.0"', "lensboy-version: is 2; splines from version 3"),
    ("lensboy.json", '"pinhole_splined"', '"pinhole_remapped"', "type: is 'pinhole_remapped'"),
    ("lensboy.json", '"num_knots_x": 7', '"num_knots_x": 6', "dx_grid: has 42 numbers, wanted 6 x 6"),
    ("lensboy.json", '"fov_deg_y": 64.0', '"fov_deg_y": 400', "fov_deg_y: is 400 of 6 knots"),
    ("realsense.txt", "404\n  Distortion: \t", "404\n  Distortion: \tInverse ", "Color.Distortion: is 'Inv"),
    ("realsense.txt", "404\n  Distortion: \t", "404\n  Distortion: \tModified ", "without tangential terms"),
    ("realsense.txt", 'To\t  "Color"', 'To\t  "Gyro"', "Color: has no extrinsic from or to Depth"),
    ("realsense.txt", "Width:      \t640", "Width:      \tmany", "Depth.Width, Height: holds something"),
    ("realsense.txt", "   0.8              0   ", "   0.9              0   ", "not a rotation"),
    ("zed.conf", "RIGHT_CAM_HD]\nfx=698", "RIGHT_CAM_HD]\nfx=", "fx, fy, cx, cy: has 3 numbers, wanted 4"),
    ("zed.conf", "Baseline=119.905", "", "STEREO: has no baseline"),
    ("zed.conf", "CV_HD=0.007", "CV_HD=", "STEREO.rx_hd, cv_hd, rz_hd: has 2 numbers, wanted 3"),
    ("zed.conf", "RX_HD", "CV_HD", "is not an INI file"),
    ("zed.conf", "k1=-0.171", "k1=", "RIGHT_CAM_HD.k1: has 0 numbers, wanted 1"),
    ("zed.conf", "k2=0.026", "k2=0.026 0.026", "RIGHT_CAM_HD.k2: has 2 numbers, wanted 1"),
    ("calib_cam_to_cam.txt", "0.1 0.001", "0.1 0,001", "D_01: holds something other than numbers"),
    ("opencv_stereo/intrinsics.yml", "D1: ", "fisheye_model1: 1\nE1: ", "fisheye_model1: "),
    ("mrcal/b.cameramodel", "-0.2, 0.1, ", "", "intrinsics: has 6 numbers, wanted 8"),
    ("mrcal/b.cameramodel", "'icam_intrinsics': 0", "'x': print('run')", "is not a dictionary of numbers"),
    ("mrcal/b.cameramodel", "    'icam_intrinsics': 0,\n}", "", "is the file whole"),
    ("kalibr.yaml", "radtan", "wide", "cam1.distortion_model: is 'wide'; supported for pinhole: radtan"),
    ("kalibr.yaml", "camera_model: pinhole", "camera_model: tele", "is 'tele'; supported: .*pinhole-radtan"),
    ("kalibr.yaml", "cam1:", "cam2:", "the chain has a gap"),
    ("colmap/cameras.txt", "PINHOLE", "WIDE", "line 4: has model WIDE, .* calibrate with one of"),
    ("colmap/cameras.txt", "\n7 OPENCV", "\n8 OPENCV", "camera 7: is used by .* and not defined"),
    ("transforms.json", '"OPENCV"', '"EQUIRECTANGULAR"', "camera_model: is EQUIRECTANGULAR; supported"),
    ("middlebury.txt", "doffs=40", "doffs=-40", "doffs: is -40, which is not the difference"),
    ("ros/left.yaml", "plumb_bob", "omni", "distortion_model: is 'omni'"),
    ("multical.json", "b_to_a", "c_to_a", "camera_poses.c_to_a: names no camera"),
    ("matlab_old.json", '"CameraParameters1"', '"Camera1"', "CameraParameters1: is missing"),
    ("metashape.xml", '"fisheye"', '"equisolid_fisheye"', "type 'equisolid_fisheye'; frame and"),
    ("metashape.xml", "<p2>-0.002</p2>", "<p2>-0.002</p2><p3>0.1</p3>", "optimise the cameras without them"),
    ("metashape.xml", "<f>500</f>", "", "sensor 0: has no f"),
    ("metashape.xml", "<f>500</f>", "<f>five</f>", "sensor 0.f: holds something other than numbers"),
    ("metashape.xml", 'sensor_id="1"', 'sensor_id="7"', "b.jpg: is of sensor '7'"),
    ("metashape.xml", "</chunk>", "</chunk><chunk></chunk>", "chunk: occurs 2 times"),
    ("metashape.xml", "</cameras>", "", "is not XML"),
    ("metashape.xml", "<document", "<!DOCTYPE a [<!ENTITY b 'c'>]><document", "defines entities"),
    ("metashape.xml", "<cameras", "<a>" * 100_000 + "<cameras", "is not XML"),
    ("kalibr_wide.yaml", "[-0.2, 0.57, 180.0", "[-1.2, 0.57, 180.0", "cam1.intrinsics: is .*, which no"),
    ("kalibr_wide.yaml", "[0.92]", "[4.0]", r"cam3.distortion_coeffs: is \[4.0\], which no fov lens has"),
    ("kalibr_wide.yaml", "[0.92]", "[0.92, 1]", "cam3.distortion_coeffs: has 2 numbers, wanted 1"),
    ("kalibr_wide.yaml", "[1.2, 400.0,", "[400.0,", "cam0.intrinsics: has 4 numbers, wanted 5"),
    ("colmap_wide/cameras.txt", "240 0.92", "240 3.5", r"line 4\.FOV: is"),
    ("colmap_wide/cameras.txt", "FOV", "RAD_TAN_THIN_PRISM_FISHEYE", "RAD_TAN.*calibrate with one of"),
    ("matlab_fisheye.json", "[300.0, ", "[-300.0, ", "MappingCoefficients: begins with -300; it is positive"),
    ("matlab_fisheye.json", "[300.0, ", "[", "MappingCoefficients: has 3 numbers, wanted 4"),
    ("opencv_stereo/extrinsics.yml", "0.8, 0., 0.6", "0.8, 0., 0.7", NO_ROTATION),
    ("colmap/images.txt", "0.9486832980505138", "0.8486832980505138", NO_ROTATION),
    ("colmap_rig/rigs.txt", "0.9486832980505138", "0.8486832980505138", NO_ROTATION),
    ("kalibr.yaml", "[0.8, 0.0, 0.6,", "[0.8, 0.0, 0.7,", NO_ROTATION),
    ("matlab_old.json", "[[0.8, 0, -0.6]", "[[0.8, 0, -0.7]", NO_ROTATION),
    ("matlab_new.json", "[[0.8, 0, 0.6]", "[[0.8, 0, 0.7]", NO_ROTATION),
    ("calib_cam_to_cam.txt", "R_01: 0.8", "R_01: 0.9", NO_ROTATION),
    ("transforms.json", "[[0.8, 0, 0.6,", "[[0.8, 0, 0.7,", NO_ROTATION),
    ("multical.json", "[[0.8, 0.0, 0.6]", "[[0.8, 0.0, 0.7]", NO_ROTATION),
    ("caliscope.toml", "[[0.8, 0.0, 0.6]", "[[0.8, 0.0, 0.7]", NO_ROTATION),
    ("ros/right.yaml", "[0.8, 0.0, -0.6,", "[0.8, 0.0, -0.7,", NO_ROTATION),
    ("cam_syntim_d", "{{0.800000,", "{{0.900000,", NO_ROTATION),
    ("boofcv.yaml", "[0.8, 0.0, -0.6,", "[0.8, 0.0, -0.7,", NO_ROTATION),
    ("pycalib.json", "[[0.8, 0, 0.6]", "[[0.8, 0, 0.7]", NO_ROTATION),
    ("metashape.xml", "0.8 0 0.6 0.05", "0.8 0 0.7 0.05", NO_ROTATION),
    ("luxonis.json", "[[0.8, 0.0, 0.6]", "[[0.8, 0.0, 0.7]", NO_ROTATION),
    ("colmap/cameras.txt", "\n7 OPENCV", "\n1 OPENCV", TWICE),
    ("colmap/images.txt", "b/0001.png", "a/0001.png", TWICE),
    ("kalibr.yaml", "cam1:", "cam0:", TWICE),
    ("transforms.json", "b.png", "a.png", TWICE),
    ("multical.json", '"b": {', '"a": {', TWICE),
    ("aniposelib.toml", '"b"', '"a"', TWICE),
    ("caliscope.toml", "[cameras.1]", "[cameras.0]", TWICE),
    ("kitti_calib.txt", "P1:", "P0:", TWICE),
    ("calib_cam_to_cam.txt", "K_01:", "K_00:", TWICE),
    ("middlebury.txt", "cam1=", "cam0=", TWICE),
]
"""A file, what in it is replaced by what, and what is said then."""


@pytest.mark.parametrize(("name", "old", "new", "message"), REFUSED)
def test_what_is_wrong_is_named(name, old, new, message, tmp_path):
    file = FIXTURES / name
    text = file.read_text()
    assert old in text
    assert re.search(message, refusal(copied(file, tmp_path, text.replace(old, new)), recognise(file)))


BENT = "distortion: {model: brown-conrady, coefficients: [0.1, 0, 0, 0]"
NATIVE = [
    ("size: [6, 4], bayer: RGBG", r"cameras.a: bayer is 'RGBG': wanted 'RGGB' or"),
    ("size: [6, 4], coding: gamma", "wanted 'srgb' or 'linear'"),
    ("size: [6, 4], bits: 12.5", "wanted a whole number from 1 to 16"),
    ("size: [6, 4], black_level: 64", "needs 'bits'"),
    ("size: [6, 4], bits: 6, black_level: 64", "not between 0 and white"),
    ("size: [6, 4], exposure: 0", "wanted a finite number above 0"),
    ("size: [6, 4], gain: [1, 2]", r"a\.gain: has 2 numbers, wanted 3"),
    ("size: [6, 4], gain: [1, 2, -1]", "gain is -1.0: wanted a finite number above 0"),
    ("size: [6, 4], frame_rate: fast", "other than numbers: 'fast'"),
    ("size: [6, 4], focal: long", "focal: holds something other than numbers: 'long'"),
    ("focal: 800", r"cameras\.a\.size: is missing"),
    ("size: [1000000, 4], focal: 80", r"cameras.a.size: is 1000000 x 4; images of up to 65535"),
    ("size: [60000, 60000]", r"cameras.a.size: is 60000 x 60000"),
    ("size: [true, 480]", "True"),
    ("size: [640, 480], focal: true", "True"),
    ("size: true", "True"),
    ("size: [6, 4], response: {wavelength: 500 600, response: 1}", r"a\.response: a curve has a response"),
    ("size: [6, 4], focal: 5, distortion: {model: [fov]}", r"distortion\.model: is '\['fov'\]', not one of"),
    (f"size: [6, 4], {BENT}}}", r"cameras\.a\.distortion: is of a camera without 'focal'.*`scale`"),
    (f"size: [6, 4], {BENT}, scale: -3}}", r"distortion\.scale: is -3; a scale is positive"),
    (f"size: [6, 4], focal: 500, {BENT}, scale: 3}}", r"distortion\.scale: unknown key"),
]


@pytest.mark.parametrize(("camera", "message"), NATIVE)
def test_what_is_wrong_with_a_camera_of_our_own_format_is_named(camera, message, tmp_path):
    (tmp_path / "rig.yaml").write_text(f"format: arraygeom-rig 1\ncameras:\n  a: {{{camera}}}\n")
    assert re.search(message, refusal(tmp_path / "rig.yaml"))


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        (
            "a: {size: [6, 4]}\nlinks: [{alpha: a, beta: a, H: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}]",
            "'a' to it",
        ),
        ('"a\\eb": {size: [6, 4]}', r"'a\\x1bb'"),
    ],
)
def test_what_no_rig_has_is_named_with_its_file(cameras, message):
    with pytest.raises(RigFileError, match=rf"mine\.yaml: .*{message}"):
        read_text(f"format: arraygeom-rig 1\ncameras:\n  {cameras}\n", "mine.yaml")


def test_a_later_version_of_our_own_format_is_refused(tmp_path):
    (tmp_path / "rig.yaml").write_text("format: arraygeom-rig 2\ncameras:\n  a: {size: [6, 4]}\n")
    assert re.search("format: is 'arraygeom-rig 2', wanted .* later version", refusal(tmp_path / "rig.yaml"))


CUT = {
    "aniposelib": (FIXTURES / "aniposelib.toml", r"(?s)(\[cam_1\]\n).*", r"\1", "cam_1: has no matrix"),
    "kitti": (FIXTURES / "kitti_calib.txt", "(?m)^P", "Q", "P0: is missing; is this a KITTI"),
    "zed": (FIXTURES / "zed.conf", r"(?s)\[STEREO\].*", "[STEREO]\n", "STEREO: has no"),
}


@pytest.mark.parametrize("format", CUT)
def test_what_is_cut_away_is_named(format, tmp_path):
    """A camera whose entries are cut off is an error that names them."""
    file, cut, left, wanted = CUT[format]
    assert wanted in refusal(copied(file, tmp_path, re.sub(cut, left, file.read_text())), format)


def test_three_coefficients_of_a_fisheye_are_read(tmp_path):
    text = (FIXTURES / "realsense.txt").read_text()
    stated = "Brown Conrady\n  Coeffs:     \t-0.2  \t0.1  \t0.001  \t-0.002  \t0  "
    assert stated in text
    changed = text.replace(stated, "Kannala Brandt4\n  Coeffs:     \t-0.2  \t0.1  \t0.001")
    lens = read_rig(copied(FIXTURES / "realsense.txt", tmp_path, changed))["Color"].distortion
    assert lens.coefficients.tolist() == [-0.2, 0.1, 0.001, 0.0]


def test_reflections_and_rounded_rotations(tmp_path):
    file = FIXTURES / "kalibr.yaml"
    text = file.read_text()
    mirrored = text.replace("[0.0, 1.0, 0.0, 0.02]", "[0.0, -1.0, 0.0, 0.02]")
    assert "is a reflection" in refusal(copied(file, tmp_path, mirrored))
    rounded = copied(file, tmp_path, text.replace("[0.8, 0.0, 0.6,", "[0.8001, 0.0, 0.6,"))
    R = read_rig(rounded)["cam1"].R
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-14)


def test_two_cameras_of_a_folder_with_one_name(tmp_path):
    file = FIXTURES / "ros" / "right.yaml"
    path = copied(file, tmp_path, file.read_text().replace("camera_name: b", "camera_name: a"))
    with pytest.raises(RigFileError, match="twice"):
        read_rig(path.parent)


def test_wrong_units_warn(tmp_path):
    file = FIXTURES / "kalibr.yaml"
    path = copied(file, tmp_path, file.read_text().replace("0.6, -0.1]", "0.6, -100.0]"))
    with pytest.warns(RigFileWarning, match=r"100 m .*units: millimetres"):
        read_rig(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rig = read_rig(path, scale=1e-3)
    assert math.isclose(float(rig["cam1"].t[0]), -0.1)
    file = FIXTURES / "middlebury.txt"
    path = copied(file, tmp_path, file.read_text().replace("baseline=200", "baseline=0.05"))
    with pytest.warns(RigFileWarning, match="millimetres"):
        read_rig(path)


def test_unstated_sizes_warn():
    advice = r"states no image size: took 1201 x 341, .* --size W H`, or `arraygeom.io.read_rig\(path, hw="
    with pytest.warns(RigFileWarning, match=advice):
        assert read_rig(FIXTURES / "kitti_calib.txt")["cam1"].hw == (341, 1201)


def test_colmap_models_that_lost_entries(tmp_path):
    """COLMAP's comment says how many images there are: a file cut between two of them is not a whole one."""
    file = FIXTURES / "colmap" / "images.txt"
    lines = file.read_text().splitlines(keepends=True)
    message = refusal(copied(file, tmp_path, "".join(lines[:6])), "colmap")
    assert message.endswith("announces 2 images and holds 1; was it cut off?")


def test_colmap_images_without_lines_of_points(tmp_path):
    """A file without lines of points is refused, as every second image would be taken for points."""
    file = FIXTURES / "colmap" / "images.txt"
    text = "".join(line for line in file.read_text().splitlines(keepends=True) if line.endswith(".png\n"))
    message = refusal(copied(file, tmp_path, text), "colmap")
    assert message.endswith("line 2: wanted the points of the image above: add a line, blank if none")
