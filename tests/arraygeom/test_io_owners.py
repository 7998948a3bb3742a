"""Rig files as their owners have them: other spellings, other makers, no lens or size stated."""

import json
import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from arraygeom import Camera, Pose, Rig, intrinsics
from arraygeom.distortion import Distortion
from arraygeom.io import RigFileError, RigFileWarning, read_rig, write_rig
from arraygeom.lens_coverage import coverage
from arraygeom.summary import summarise_cameras
from tests.arraygeom.test_io import FIXTURES, assert_is_the_pair

C = [-0.3, 0.1, 0.0005, -0.0004, 0.0]
K = [700.0, 0.0, 640.0, 0.0, 700.0, 360.0, 0.0, 0.0, 1.0]


def read(path: Path, text: str | dict, **options) -> tuple[Rig, str]:
    """The rig of a file with this text, and all warnings as one text."""
    path.parent.mkdir(exist_ok=True, parents=True)
    path.write_text(text if isinstance(text, str) else json.dumps(text))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", RigFileWarning)
        return read_rig(path, **options), "\n".join(str(w.message) for w in caught)


def matrix(name: str, numbers: list[float], rows: int) -> str:
    columns = len(numbers) // rows
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: {numbers}\n"


def opencv(names: tuple[str, str] | None, c: list[float], more: str = "") -> str:
    """A file of OpenCV's with K and a lens under these names; by the names' "1", a pair."""
    K_name, lens = names
    text = f"%YAML:1.0\n---\n{more}image_width: 1280\nimage_height: 720\n"
    for i in "12" if "1" in lens else "1":
        text += matrix(K_name.replace("1", i), K, 3) + matrix(lens.replace("1", i), c, 1)
    if "1" in lens:
        text += matrix("R", [1, 0, 0, 0, 1, 0, 0, 0, 1], 3) + matrix("T", [-0.1, 0, 0], 3)
    return text


@pytest.mark.parametrize(
    "names",
    [
        *[("K1", lens) for lens in ("d1", "distCoeff1", "dist_coeff1", "distortion1", "kc1", "Dist1")],
        *[("cameraMatrix1", lens) for lens in ("distCoefs1", "distortion_coeffs1", "dist_params1")],
        *[("camera_matrix", lens) for lens in ("dist_coeff", "distortion", "dist", "distortion_params")],
        *[("mtx", "dist"), ("intrinsic_matrix", "distortion_vector"), ("K", "DistortionCoefficients")],
    ],
)
def test_opencvs_lens_under_any_usual_name(names, tmp_path):
    rig, said = read(tmp_path / "a.yml", opencv(names, C))
    for camera in rig.cameras.values():
        assert camera.distortion.coefficients.tolist() == C
    assert not said


def test_sides_by_their_words(tmp_path):
    text = "%YAML:1.0\n---\nimage_width: 1280\nimage_height: 720\n"
    for side in ("left", "right"):
        text += matrix(f"{side}_camera_matrix", K, 3) + matrix(f"dist_{side}", C, 1)
    text += matrix("rotation", [1, 0, 0, 0, 1, 0, 0, 0, 1], 3) + matrix("translation", [-0.1, 0, 0], 3)
    rig, said = read(tmp_path / "a.yml", text)
    assert rig.names == ("left", "right")
    assert rig["right"].distortion.coefficients.tolist() == C
    assert not said


IDENTITY = np.eye(4).tolist()
SPELLED = {
    "K.json": {"K": np.reshape(K, (3, 3)).tolist(), "dist": C, "R": np.eye(3).tolist(), "t": [0, 0, 0]},
    "alone.json": {"camera_matrix": np.reshape(K, (3, 3)).tolist(), "dist_coeff": [C]},
    "transforms.json": {
        **{"fl_x": 700, "fl_y": 700, "cx": 640.5, "cy": 360.5, "w": 1280, "h": 720},
        "distortion_params": [C[0], C[1], 0, 0, C[2], C[3]],
        "frames": [{"file_path": "a.png", "transform_matrix": IDENTITY}],
    },
    "anipose.toml": (
        f'[cam_0]\nname="a"\nsize=[1280,720]\nmatrix={np.reshape(K, (3, 3)).tolist()}\ndist={C}\n'
        "rotation=[0.0,0.0,0.0]\ntranslation=[0.0,0.0,0.0]\n"
    ),
    "kalibr.yaml": (
        f"cam0:\n  camera_model: pinhole\n  distortion_coeffs: {C[:4]}\n"
        "  intrinsics: [700, 700, 640, 360]\n  resolution: [1280, 720]\n"
    ),
}


@pytest.mark.parametrize("name", SPELLED)
def test_lenses_under_other_names(name, tmp_path):
    rig, _ = read(
        tmp_path / name, SPELLED[name], hw=(720, 1280) if name in ("K.json", "alone.json") else None
    )
    (camera,) = rig.cameras.values()
    assert camera.distortion.coefficients.tolist()[:4] == C[:4]


FISHEYE = [-0.0125, 0.0537, -0.0504, 0.0102]
NUMBERS = dict(zip(("fx", "fy", "cx", "cy"), (700, 700, 640, 360)))
LENS = dict(zip(("k1", "k2", "p1", "p2", "k3"), C))
MATRIX = np.reshape(K, (3, 3)).tolist()
POSED = {"R": np.eye(3).tolist(), "t": [0, 0, 0], "image_size": [1280, 720]}
USUAL = {
    "flat.json": {**NUMBERS, **LENS, "width": 1280, "height": 720},
    "texts.json": {"K": " ".join(map(str, K)), "dist": " ".join(map(str, C)), "size": "1280 720"},
    "nested.json": {"camera": {"intrinsics": NUMBERS, "distortion": LENS, "resolution": [1280, 720]}},
    "list.json": {
        "cameras": [{"name": n, "camera_matrix": MATRIX, "dist_coeffs": [C], **POSED} for n in "ab"]
    },
    "pair.json": {
        **{n: {"K": MATRIX, "d": C, "w": 1280, "h": 720} for n in ("left", "right")},
        **{"R": np.eye(3).tolist(), "T": [[-0.1], [0], [0]]},
    },
    "four.toml": f"[cam_1]\nintrinsics = [700, 700, 640, 360]\ndist = {C}\nresolution = [1280, 720]\n",
    "zero.json": {
        **{f"{name}{i}": value for i in "01" for name, value in (("K", MATRIX), ("D", C))},
        **{"R": np.eye(3).tolist(), "T": [-0.1, 0, 0], "image_size": [1280, 720]},
    },
    "placed.json": {
        "cameras": {
            n: {
                "intrinsics": NUMBERS,
                "dist": C,
                "size": [1280, 720],
                "extrinsics": {"R": [0, 0, 0], "t": [0, 0, 1]},
            }
            for n in "ab"
        }
    },
    "extrinsic.json": {"K": MATRIX, "distCoeffs": C, "world_to_cam": IDENTITY, "imgSize": [1280, 720]},
    "slam.yaml": (
        '%YAML:1.0\n---\n# Camera\nCamera.type: "PinHole"\n'
        + "".join(f"Camera.{name}: {value}\n" for name, value in {**NUMBERS, **LENS}.items())
        + "Camera.width: 1280\nCamera.height: 720\nCamera.fps: 20.0\n"
    ),
}


@pytest.mark.parametrize("name", USUAL)
def test_usual_names_are_read_in_any_language_and_depth(name, tmp_path):
    """K as a matrix, four numbers or one by one; a lens as a list or one by one; a size as one or two."""
    rig, said = read(tmp_path / name, USUAL[name])
    for camera in rig.cameras.values():
        assert camera.K.flatten().tolist() == K
        assert camera.distortion.coefficients.tolist() == C
        assert camera.hw == (720, 1280)
    assert not said
    assert len(rig.names) == 2 or name not in ("zero.json", "placed.json")
    assert rig.names == {"list.json": ("a", "b"), "pair.json": ("left", "right")}.get(name, rig.names)
    if name == "pair.json":
        assert rig["right"].t.tolist() == [-0.1, 0, 0]


def test_a_fisheye_by_its_numbers_names(tmp_path):
    """Four k and no p are no lens of Brown's."""
    document = NUMBERS | dict(zip(("k1", "k2", "k3", "k4"), FISHEYE)) | {"width": 1280, "height": 720}
    (camera,) = read(tmp_path / "a.json", document)[0].cameras.values()
    assert camera.distortion.model == "kannala-brandt"
    assert camera.distortion.coefficients.tolist() == FISHEYE
    stated = read_rig(tmp_path / "a.json", lens="brown-conrady")
    assert next(iter(stated.cameras.values())).distortion.model == "brown-conrady"


@pytest.mark.parametrize("missing", ["R", "t"])
def test_several_cameras_without_a_place_are_refused(missing, tmp_path):
    cameras = [{"K": MATRIX, "dist": C, **POSED} for _ in range(2)]
    del cameras[1][missing]
    with pytest.raises(RigFileError, match=rf"cameras\[1\].*\b{missing}\b"):
        read(tmp_path / "a.json", {"cameras": cameras})


UNREAD = [
    ("kalibr.yaml", "cam0:", "cam0:\n  xi: 0.9", "cam0.xi"),
    ("kalibr.yaml", "cam0:", "cam0:\n  lens_distortion: {k1: 0.1}", "lens_distortion"),
    ("anipose.toml", "size=", "radial=[0.1, 0.2]\nsize=", "cam_0.radial"),
    ("anipose.toml", "size=", 'projection="fisheye624"\nsize=', "fisheye624"),
    ("transforms.json", '"fl_x"', '"k5": 0.1, "fl_x"', "k5"),
    ("transforms.json", '"fl_x"', '"undistorted": true, "fl_x"', "undistorted"),
    ("K.json", '"dist"', '"units": "mm", "dist"', "units"),
]


@pytest.mark.parametrize(("name", "old", "new", "entry"), UNREAD)
def test_what_looks_like_a_lens_is_not_passed_over(name, old, new, entry, tmp_path):
    """Whatever reader: an entry that is not read and may change what a camera sees is named."""
    text = SPELLED[name] if isinstance(SPELLED[name], str) else json.dumps(SPELLED[name])
    assert old in text
    try:
        _, said = read(tmp_path / name, text.replace(old, new, 1), hw=None)
    except RigFileError as error:
        said = str(error)
    assert entry in said


@pytest.mark.parametrize(
    "file", ["kitti_calib.txt", "middlebury.txt", "multical.json", "aniposelib.toml", "ros/right.yaml"]
)
def test_unread_lenses_of_other_formats(file, tmp_path):
    """Entries beside those that are read, in each format's own syntax."""
    text, name = (FIXTURES / file).read_text(), Path(file).name
    added = {
        "txt": "distortion_coeffs{} -0.1\n",
        "toml": "lens_coeffs=[1, 2]\n",
        "yaml": "lens_coeffs: [1, 2]\n",
    }
    line = added.get(name.rpartition(".")[2], "")
    text = text + line.format(":" if "kitti" in name else "=") if "txt" in name or "yaml" in name else text
    text = text.replace("size", f"{line}size", 1) if "toml" in name else text
    text = text.replace('"image_size"', '"lens_coeffs": [1, 2], "image_size"', 1) if "json" in name else text
    _, said = read(tmp_path / name, text, hw=(370, 1240) if "kitti" in name else None)
    assert "coeffs" in said


@pytest.mark.parametrize("word", ['distortion_model: "fisheye"', "fisheye: 1", 'model: "equidistant"'])
def test_fisheyes_by_the_files_own_word(word, tmp_path):
    rig, said = read(tmp_path / "a.yml", opencv(("K1", "D1"), FISHEYE, f"{word}\n"))
    assert {camera.distortion.model for camera in rig.cameras.values()} == {"kannala-brandt"}
    assert not said


def test_four_coefficients_without_a_word(tmp_path):
    """Tangential terms of 0.05 are no Brown lens's; a warning states the chosen model, and --lens decides."""
    rig, said = read(tmp_path / "a.yml", opencv(("K1", "D1"), FISHEYE))
    assert rig["left"].distortion.model == "kannala-brandt"
    assert "D1" in said
    assert "--lens brown-conrady" in said
    rig, said = read(tmp_path / "a.yml", opencv(("K1", "D1"), C[:4]))
    assert rig["left"].distortion.model == "brown-conrady"
    assert "--lens kannala-brandt" in said
    rig, said = read(tmp_path / "a.yml", opencv(("K1", "D1"), C[:4]), lens="kannala-brandt")
    assert rig["left"].distortion.model == "kannala-brandt"
    assert not said
    with pytest.raises(RigFileError, match="fisheye"):
        read(tmp_path / "a.yml", opencv(("K1", "D1"), FISHEYE, "fisheye: 1\n"), lens="brown-conrady")
    with pytest.raises(ValueError, match="'wide'"):
        read(tmp_path / "a.yml", opencv(("K1", "D1"), FISHEYE), lens="wide")


def test_no_lens_is_said(tmp_path):
    text = "%YAML:1.0\n---\nimage_width: 1280\nimage_height: 720\n" + matrix("camera_matrix", K, 3)
    rig, said = read(tmp_path / "a.yml", text)
    assert rig["camera"].distortion is None
    assert "no lens" in said


def test_what_opencv_wrote_by_us_says_its_lens(tmp_path):
    camera = Camera(K=intrinsics((700, 700), (720, 1280)), cam_from_world=Pose.identity(), hw=(720, 1280))
    write_rig(Rig({"a": camera}), tmp_path / "a.yml", format="opencv")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_rig(tmp_path / "a.yml")["a"].distortion is None


# Sizes ------------------------------------------------------------------------------------------------------

SIZES = {
    "opencv_stereo": [],
    "kitti_calib.txt": [],
    "pycalib.json": [],
    "matlab_old.json": [('"ImageSize": [480, 640]', '"ImageSize": []')],
    "transforms.json": [('"w": 640,', "")],
    "kalibr.yaml": [("  resolution: [640, 480]\n", "")],
    "multical.json": [('"image_size": [640, 480]', '"unused": 0')],
    "aniposelib.toml": [("size = [640, 480]\n", ""), ("size = [ 640, 480,]\n", "")],
    "boofcv.yaml": [("width: 640", "unused: 0")],
    "ros/left.yaml": [("image_width: 640\n", "")],
    "open3d.json": [('"width": 640', '"unused": 0')],
    "middlebury.txt": [("width", "unused")],
    "mrcal/a.cameramodel": [("'imagersize'", "'unused'")],
    "lensboy.json": [('"image_width"', '"unused"')],
    "mccalib.yml": [("img_width", "unused")],
    "easymocap": [],
}


@pytest.mark.parametrize("file", SIZES)
def test_every_reader_takes_a_size_that_its_file_does_not_state(file, tmp_path):
    """Formats that state none, and those that usually do."""
    path = FIXTURES / file
    if file == "easymocap":
        for part in path.iterdir():
            lines = part.read_text().splitlines(keepends=True)
            (tmp_path / part.name).write_text("".join(x for x in lines if not x.startswith(("H_", "W_"))))
        path = tmp_path
    elif SIZES[file]:
        text = path.read_text()
        for old, new in SIZES[file]:
            text = text.replace(old, new)
        assert text != path.read_text()
        path = tmp_path / path.name
        path.write_text(text)
    rig = read_rig(path, hw=(1000, 1100))
    assert {camera.hw for camera in rig.cameras.values()} == {(1000, 1100)}


def test_nerfs_synthetic_scenes(tmp_path):
    """The angle of view and no size: f = 400 / tan(0.6911112 / 2)."""
    frames = [{"file_path": "./train/r_0", "rotation": 0.01, "transform_matrix": IDENTITY}]
    document = {"camera_angle_x": 0.6911112070083618, "frames": frames}
    camera = read(tmp_path / "transforms.json", document, hw=(800, 800))[0]["./train/r_0"]
    assert float(camera.K[0, 0]) == pytest.approx(1111.11, abs=0.01)
    assert camera.K[:2, 2].tolist() == [399.5, 399.5]
    with pytest.raises(RigFileError, match="--size"):
        read(tmp_path / "transforms.json", document)


# Makers -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("file", "names"),
    [
        ("azure.json", ("depth", "color")),
        ("mccalib.yml", ("camera_0", "camera_1")),
        ("easymocap", ("01", "02")),
        ("easymocap/intri.yml", ("01", "02")),
    ],
)
def test_pairs_of_other_makers(file, names):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_is_the_pair(read_rig(FIXTURES / file), names)


def test_a_kinects_colour_in_a_mode_of_another_shape():
    """The maker's own: the sensor scaled in width, and cut above and below."""
    color = read_rig(FIXTURES / "azure.json", hw=(720, 1280))["color"]
    assert color.hw == (720, 1280)
    x = color.project_local(torch.tensor([0.4, -0.2, 2.0], dtype=torch.float64)).x
    assert x.tolist() == pytest.approx([2 * (389.35 + 0.5) - 0.5, 2 * (204.8045 + 0.5) - 120 - 0.5])


def sensor_yaml(pose: np.ndarray, numbers: list[float], c: list[float]) -> str:
    return (
        "# General sensor definitions.\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n"
        f"  data: {pose.ravel().tolist()}\nrate_hz: 20\nresolution: [640, 480]\ncamera_model: pinhole\n"
        f"intrinsics: {numbers}\ndistortion_model: radial-tangential\ndistortion_coefficients: {c}\n"
    )


@pytest.mark.parametrize("place", [".", "mav0"])
def test_eurocs_sensors(place, tmp_path):
    """T_BS takes points of the camera into the body, here camera a."""
    pose = np.eye(4)
    pose[:3] = [[0.8, 0, -0.6, 0.098], [0, 1, 0, -0.02], [0.6, 0, 0.8, 0.036]]
    cameras = {"cam0": (np.eye(4), [500, 510, 319.5, 239.5], [0, 0, 0, 0])}
    cameras["cam1"] = (pose, [400, 404, 310.25, 244.75], [-0.2, 0.1, 0.001, -0.002])
    for name, camera in cameras.items():
        read(tmp_path / place / name / "sensor.yaml", sensor_yaml(*camera))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_is_the_pair(read_rig(tmp_path), ("cam0", "cam1"))


@pytest.mark.parametrize("lower", [False, True])
def test_a_ros_message_as_text(lower, tmp_path):
    """The text of `rostopic echo` (ROS 1: K, D) and `ros2 topic echo` (k, d)."""
    text = (
        'header: \n  seq: 1\n  frame_id: "cam"\nheight: 480\nwidth: 640\ndistortion_model: "plumb_bob"\n'
        "D: [-0.2, 0.1, 0.001, -0.002, 0.0]\nK: [400.0, 0.0, 310.25, 0.0, 404.0, 244.75, 0.0, 0.0, 1.0]\n"
        "R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]\n"
        "P: [400.0, 0.0, 310.25, 0.0, 0.0, 404.0, 244.75, 0.0, 0.0, 0.0, 1.0, 0.0]\nbinning_x: 0\n"
        "---\nheader:\n"
    )
    for name in "DKRP" if lower else "":
        text = text.replace(f"\n{name}: ", f"\n{name.lower()}: ")
    rig, said = read(tmp_path / "info.txt", text)
    x = rig["cam"].project(torch.tensor([0.4, -0.2, 2.0], dtype=torch.float64)).x
    assert x.tolist() == pytest.approx([389.35, 204.8045])
    assert not said


ZED = (
    "[LEFT_CAM_FHD1200]\nfx = 735.4\nfy = 735.2\ncx = 958.9\ncy = 598.7\n"
    "[RIGHT_CAM_FHD1200]\nfx = 736.3\nfy = 735.8\ncx = 966.3\ncy = 596.7\n"
    "[LEFT_DISTO]\nk1 = 0.75\nk2 = 1.1\np1 = -0.0001\np2 = -0.0002\nk3 = 0.105\n"
    "k4 = 0.766\nk5 = 1.15\nk6 = 0.25\n"
    "[RIGHT_DISTO]\nk1 = 0.76\nk2 = 1.12\np1 = 0.0001\np2 = -0.0001\nk3 = 0.106\n"
    "k4 = 0.777\nk5 = 1.17\nk6 = 0.26\n"
    "[STEREO]\nBaseline = 50\nTY = 0.5\nTZ = -0.4\nCV_FHD1200 = 0.006\n"
    "RX_FHD1200 = -0.001\nRZ_FHD1200 = 0.0008\n"
)


def test_zeds_lens_of_its_own_section(tmp_path):
    """Pixels by OpenCV from the numbers as the maker's calibration tool writes them."""
    cv2 = pytest.importorskip("cv2")
    rig, said = read(tmp_path / "SN1.conf", ZED)
    assert not said
    X = np.array([[0.3, -0.2, 1.5], [-0.6, 0.4, 1.2], [0.05, 0.02, 3.0]])
    K = np.array([[736.3, 0, 966.3], [0, 735.8, 596.7], [0, 0, 1]])
    c = np.array([0.76, 1.12, 0.0001, -0.0001, 0.106, 0.777, 1.17, 0.26])
    wanted = cv2.projectPoints(
        X, np.array([-0.001, 0.006, 0.0008]), np.array([-0.05, 0.0005, -0.0004]), K, c
    )[0][:, 0]
    np.testing.assert_allclose(rig["right"].project(torch.from_numpy(X)).x.numpy(), wanted, atol=1e-6)
    four = ZED.replace("FHD1200", "4k").replace("fx = 735.4", "fx = 735.4 ; pixels")
    assert read(tmp_path / "SN1.conf", four)[0]["left"].hw == (2160, 3840)
    one = four[: four.index("[RIGHT_CAM")] + four[four.index("[LEFT_DISTO]") :]
    assert read(tmp_path / "SN1.conf", one)[0].names == ("left",)
    with pytest.raises(RigFileError, match="k1"):
        read(tmp_path / "SN1.conf", ZED.replace("_DISTO", "_OTHER"))
    with pytest.raises(RigFileError, match="LEFT_CAM"):
        read(tmp_path / "SN1.conf", ZED.replace("LEFT_CAM", "OTHER"), format="zed")


def test_an_uncalibrated_camera_of_an_oak_is_left_out(tmp_path):
    document = json.loads((FIXTURES / "luxonis.json").read_text())
    third = json.loads(json.dumps(document["cameraData"][1][1])) | {"intrinsicMatrix": [[0] * 3] * 3}
    document["cameraData"].append([0, third])
    rig, said = read(tmp_path / "calib.json", document)
    assert rig.names == ("CAM_B", "CAM_C")
    assert "CAM_A" in said


def metashape(labels: tuple[str, ...]) -> str:
    """Two captures of a camera with two bands, 2 cm apart; the second one is 1 m further right."""
    sensor = '<resolution width="640" height="480"/><calibration type="frame"><f>500</f></calibration>'
    slave = f"{sensor}<rotation>1 0 0 0 1 0 0 0 1</rotation><location>0.02 0 0</location>"
    transforms = [f"1 0 0 {x} 0 1 0 0 0 0 1 0 0 0 0 1" for x in (0, 1)]
    cameras = "".join(
        f'<camera id="{2 * i}" sensor_id="0" label="{labels[2 * i]}"><transform>{T}</transform></camera>'
        f'<camera id="{2 * i + 1}" sensor_id="1" master_id="{2 * i}" label="{labels[2 * i + 1]}"/>'
        for i, T in enumerate(transforms)
    )
    return (
        f'<document><chunk><sensors><sensor id="0">{sensor}</sensor><sensor id="1" master_id="0">{slave}'
        f"</sensor></sensors><cameras>{cameras}</cameras></chunk></document>"
    )


def test_metashapes_multi_camera_systems(tmp_path):
    rig, said = read(tmp_path / "a.xml", metashape(("1_G", "1_NIR", "2_G", "2_NIR")))
    assert [camera.centre[0].item() for camera in rig.cameras.values()] == pytest.approx([0, 0.02, 1, 1.02])
    assert not said
    rig, _ = read(tmp_path / "a.xml", metashape(("1_G", "1_NIR", "1_G", "2_NIR")))
    assert len(rig.names) == 4
    text = metashape(("1_G", "1_NIR", "2_G", "2_NIR")).replace("<location>0.02 0 0</location>", "")
    rig, said = read(tmp_path / "a.xml", text.replace("<rotation>1 0 0 0 1 0 0 0 1</rotation>", ""))
    assert rig.names == ("1_G", "2_G")
    assert "1_NIR" in said


LIKELY = {
    "ORB-SLAM": '%YAML:1.0\nCamera.type: "PinHole"\nCamera.fx: 435.2\n',
    "Kalibr": "camera0:\n  T_cn_cnm1: []\n  rostopic: /a\n",
    "OpenCV": '{"my_cameraMatrix": 3}',
}


@pytest.mark.parametrize("name", LIKELY)
def test_unknown_files_are_told_what_they_may_be(name, tmp_path):
    """And to write a rig file, instead of a list of all formats."""
    (tmp_path / "rig.dat").write_text(LIKELY[name])
    with pytest.raises(RigFileError, match=name) as caught:
        read_rig(tmp_path / "rig.dat")
    assert "focal" in str(caught.value)
    assert "syntim" not in str(caught.value)


# Lenses that end within their images ------------------------------------------------------------------------

POLE = [-9.2, 65.3, 0, 0, -87.72, -9.278, 65.55, -87.83]


def pole() -> Camera:
    """A rational lens whose numerator and denominator all but cancel beside a pole, as factory fits have."""
    K = torch.tensor([[808.0, 0, 640], [0, 808, 400], [0, 0, 1]], dtype=torch.float64)
    lens = Distortion("brown-conrady", torch.tensor(POLE, dtype=torch.float64))
    return Camera(K=K, cam_from_world=Pose.identity(), hw=(800, 1280), distortion=lens)


def test_a_lens_that_ends_within_its_image_is_said(tmp_path):
    """A pole at tan(37.8 degrees): 17 % of the image has no ray."""
    rig = Rig({"CAM_B": pole()})
    share, degrees = coverage(pole())
    assert share == pytest.approx(0.83, abs=0.01)
    assert degrees == pytest.approx(36.5, abs=1)
    assert any("CAM_B" in text and "17 %" in text for text in rig.check())
    rig.save(tmp_path / "rig.yaml")
    with pytest.warns(RigFileWarning, match=r"CAM_B.*--refit"):
        read_rig(tmp_path / "rig.yaml")
    (summary,) = summarise_cameras(rig)
    assert (summary.lens, summary.coefficients) == ("brown-conrady", tuple(POLE))
    assert summary.covered == pytest.approx(0.83, abs=0.01)
    across, down = summary.field_of_view
    assert across == pytest.approx(73, abs=1.5), "to the pole, which no number said"
    assert down == pytest.approx(2 * math.degrees(math.atan(400 / 808)), abs=1)


def test_a_comment_before_the_first_yaml_document_is_none(tmp_path):
    (tmp_path / "a.yaml").write_text(
        f"# of the lab\n---\n{json.dumps({'K': MATRIX, 'dist': C})}\n---\nsecond: 1\n"
    )
    (camera,) = read_rig(tmp_path / "a.yaml", hw=(720, 1280)).cameras.values()
    assert camera.K.flatten().tolist() == K
