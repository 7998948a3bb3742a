"""Rig files with wide lenses: world points' pixels against each tool's own formula, in numpy, its pixels."""

import json

import numpy as np
import pytest
import torch

from arraygeom import Rig
from arraygeom.io import RigFileError, RigFileWarning, read_rig, recognise, write_rig
from tests.arraygeom.test_central_lenses import FORMULAS
from tests.arraygeom.test_io import FIXTURES

ZED_K = (700, 701, 640.35, 356.42), (698, 699, 637.9, 361.1)
ZED_C = np.array([[-0.17, 0.025, 0.0001, -0.0002, 0], [-0.171, 0.026, 0.0002, -0.0001, 0]])
POINTS = np.array([[0.3, -0.2, 1.5], [-0.6, 0.4, 1.2], [0.05, 0.02, 3.0], [1.0, 0.3, 1.4], [-0.9, -0.8, 2.0]])


def pixels(rig: Rig, name: str, X: np.ndarray) -> np.ndarray:
    found = rig[name].project(torch.from_numpy(X))
    assert found.valid.all()
    return found.x.numpy()


def through(model: str, c, focal, centre, X: np.ndarray) -> np.ndarray:
    return FORMULAS[model][0](X, *c)[0] * focal + centre


KALIBR = {
    "cam0": ("unified", (1.2, -0.1, 0.02, 0.001, -0.002), (400, 402), (319.5, 239.5)),
    "cam1": ("double-sphere", (-0.2, 0.57), (180, 181), (320, 240)),
    "cam2": ("extended-unified", (0.6, 1.1), (200, 201), (321, 241)),
    "cam3": ("fov", (0.92,), (300, 301), (318, 238)),
}


def test_kalibrs_wide_cameras():
    """cam n is 0.1 m further right; Kalibr's pixels are ours."""
    rig = read_rig(FIXTURES / "kalibr_wide.yaml")
    for i, (name, lens) in enumerate(KALIBR.items()):
        expected = through(*lens, POINTS - [0.1 * i, 0, 0])
        np.testing.assert_allclose(pixels(rig, name, POINTS), expected, atol=1e-9)


SPLINED = {
    "splined_quadratic.cameramodel": [
        *([203.0801058, 91.3013001], [66.2592018, 181.1903377], [166.5018141, 119.3022604]),
        *([287.9837165, 160.7773555], [76.7903893, 45.3919523]),
    ],
    "splined_cubic.cameramodel": [
        *([191.3779769, 97.5998981], [91.3854572, 163.8429519], [164.7146297, 118.3932334]),
        *([255.3497842, 148.6349385], [98.8161924, 61.5929395]),
    ],
    "lensboy.json": [
        *([199.5283693, 91.2921426], [60.7742698, 185.4619071], [161.9432258, 117.327744]),
        *([306.7872959, 162.6586132], [70.1686254, 37.5007067]),
    ],
}
"""The pixels of `POINTS` that mrcal 2.2 (`mrcal.project`) and lensboy 4.0.3 (`project_points`) give."""


@pytest.mark.parametrize("file", SPLINED)
def test_splined_cameras(file, tmp_path):
    """Random knots; written in our own format, the camera is the same."""
    rig = read_rig(FIXTURES / file)
    (name,) = rig.names
    np.testing.assert_allclose(pixels(rig, name, POINTS), SPLINED[file], atol=1e-7)
    rig.save(tmp_path / "rig.yaml")
    again = Rig.load(tmp_path / "rig.yaml")
    np.testing.assert_array_equal(pixels(again, name, POINTS), pixels(rig, name, POINTS))


def test_mrcals_sphere(tmp_path):
    """LENSMODEL_LONLAT: fx and fy are pixels a radian."""
    text = (FIXTURES / "mrcal" / "b.cameramodel").read_text()
    text = text.replace("OPENCV4", "LONLAT").replace("-0.2, 0.1, 0.001, -0.002,", "")
    (tmp_path / "sphere.cameramodel").write_text(text)
    rig = read_rig(tmp_path / "sphere.cameramodel")
    X = rig["sphere"].cam_from_world.apply(torch.from_numpy(POINTS)).numpy()
    longitude, latitude = np.arctan2(X[:, 0], X[:, 2]), np.arcsin(X[:, 1] / np.linalg.norm(X, axis=1))
    expected = np.stack([400 * longitude + 310.25, 404 * latitude + 244.75], -1)
    np.testing.assert_allclose(pixels(rig, "sphere", POINTS), expected, atol=1e-9)


REALSENSE = {
    "Modified Brown Conrady": ("-0.2  \t0.1  \t0  \t0  \t0.01", "brown-conrady", [-0.2, 0.1, 0, 0, 0.01]),
    "Kannala Brandt4": (
        "0.1  \t-0.02  \t0.003  \t-0.004  \t0",
        "kannala-brandt",
        [0.1, -0.02, 0.003, -0.004],
    ),
}


@pytest.mark.parametrize(("kind", "case"), REALSENSE.items(), ids=list(REALSENSE))
def test_realsenses_other_lenses(kind, case, tmp_path):
    """Fisheyes are printed with a fifth number; without tangential terms the modified is the plain one."""
    text = (FIXTURES / "realsense.txt").read_text().replace("-0.2  \t0.1  \t0.001  \t-0.002  \t0", case[0])
    (tmp_path / "camera.txt").write_text(
        text.replace("404\n  Distortion: \tBrown Conrady", f"404\n  Distortion: \t{kind}")
    )
    lens = read_rig(tmp_path / "camera.txt")["Color"].distortion
    assert (lens.model, lens.coefficients.tolist()) == (case[1], pytest.approx(case[2]))


def test_zeds_rows_are_those_that_the_makers_code_makes():
    """Its calibration tool writes OpenCV's rotation vector (RX, CV, RZ) and T = (-Baseline, TY, TZ)."""
    rig = read_rig(FIXTURES / "zed.conf")
    K = [np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]) for fx, fy, cx, cy in ZED_K]
    cv2 = pytest.importorskip("cv2")
    R, t = cv2.Rodrigues(np.array([0.0024, 0.007, -0.0021]))[0], np.array([-119.905, 0.5, -2.5])
    R1, R2, P1, P2 = cv2.stereoRectify(K[0], ZED_C[0], K[1], ZED_C[1], (1280, 720), R, t)[:4]
    rows = [
        cv2.undistortPoints(pixels(rig, name, POINTS)[:, None], *camera)[:, 0, 1]
        for name, camera in (
            ("left", (K[0], ZED_C[0], None, R1, P1)),
            ("right", (K[1], ZED_C[1], None, R2, P2)),
        )
    ]
    np.testing.assert_allclose(*rows, atol=0.01)
    assert rig["right"].centre[0] == pytest.approx(0.12, abs=1e-3)
    assert float(rig["right"].project(torch.tensor([0.0, 0, 10])).x[0] - 637.9) < 0


def test_zeds_sizes(tmp_path):
    """The largest, or the one that is asked for; fisheyes by their k4; numbers with a decimal comma."""
    small = read_rig(FIXTURES / "zed.conf", hw=(376, 672))
    assert small["left"].distortion.model == "kannala-brandt"
    assert small["left"].distortion.coefficients.tolist() == [-0.03, -0.004, 0.037, -0.02]
    (tmp_path / "SN1.conf").write_text((FIXTURES / "zed.conf").read_text().replace("119.905", "119,905"))
    torch.testing.assert_close(
        read_rig(tmp_path / "SN1.conf")["right"].centre, read_rig(FIXTURES / "zed.conf")["right"].centre
    )
    with pytest.raises(RigFileError, match=r"1920x1080.*1280x720"):
        read_rig(FIXTURES / "zed.conf", hw=(1080, 1920))


def test_colmaps_wide_cameras():
    """COLMAP's first pixel has its centre at 0.5."""
    rig = read_rig(FIXTURES / "colmap_wide")
    prism = (0.05, -0.01, 0.001, -0.002, 0.003, -0.0005, 0.001, -0.0007)
    left = through("fov", (0.92,), (400, 404), (320, 240), POINTS) - 0.5
    right = through("thin-prism-fisheye", prism, (260, 262), (321, 239), POINTS - [0.1, 0, 0]) - 0.5
    np.testing.assert_allclose(pixels(rig, "left.png", POINTS), left, atol=1e-9)
    np.testing.assert_allclose(pixels(rig, "right.png", POINTS), right, atol=1e-9)


@pytest.mark.parametrize(("file", "format"), [("kalibr_wide.yaml", "kalibr"), ("colmap_wide", "colmap")])
def test_wide_lenses_survive_writing(file, format, tmp_path):
    rig = read_rig(FIXTURES / file)
    for written in ("native", format):
        path = tmp_path / ("model" if written == "colmap" else f"{written}.yaml")
        write_rig(rig, path, format=written)
        again = read_rig(path)
        for mine, theirs in zip(rig.cameras.values(), again.cameras.values()):
            assert mine.distortion.model == theirs.distortion.model
            torch.testing.assert_close(mine.distortion.coefficients, theirs.distortion.coefficients)
            torch.testing.assert_close(mine.K, theirs.K)


def metashape_frame(X, f, cx, cy, b1, b2, k, p):
    """The manual's appendix of camera models: frame cameras. Pixels with the first centre at 0.5."""
    x, y = X[:, 0] / X[:, 2], X[:, 1] / X[:, 2]
    return metashape_polynomials(x, y, f, cx, cy, b1, b2, k, p)


def metashape_fisheye(X, f, cx, cy, b1, b2, k, p):
    x0, y0 = X[:, 0] / X[:, 2], X[:, 1] / X[:, 2]
    r0 = np.sqrt(x0**2 + y0**2)
    return metashape_polynomials(x0 * np.arctan(r0) / r0, y0 * np.arctan(r0) / r0, f, cx, cy, b1, b2, k, p)


def metashape_polynomials(x, y, f, cx, cy, b1, b2, k, p):
    r = np.sqrt(x**2 + y**2)
    radial = 1 + k[0] * r**2 + k[1] * r**4 + k[2] * r**6 + k[3] * r**8
    xd = x * radial + p[0] * (r**2 + 2 * x**2) + 2 * p[1] * x * y
    yd = y * radial + p[1] * (r**2 + 2 * y**2) + 2 * p[0] * x * y
    return np.stack([640 * 0.5 + cx + xd * f + xd * b1 + yd * b2, 480 * 0.5 + cy + yd * f], -1)


def test_metashape():
    """Lengths are twice those of the chunk; b's transform is camera->chunk."""
    assert recognise(FIXTURES / "metashape.xml") == "metashape"
    with pytest.warns(RigFileWarning, match="aligned"):
        rig = read_rig(FIXTURES / "metashape.xml")
    assert rig.names == ("a.jpg", "b.jpg")
    one = metashape_frame(POINTS, 500, 3.5, -2.25, 1.5, 0.75, (-0.1, 0.02, -0.003, 0), (0.001, -0.002)) - 0.5
    np.testing.assert_allclose(pixels(rig, "a.jpg", POINTS), one, atol=1e-9)
    R = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    ahead = POINTS @ R.T + 2 * np.array([0.05, 0.01, 0.02])
    two = metashape_fisheye(POINTS, 260, 1, -1, 0, 0, (0.05, -0.01, 0.003, -0.0005), (0.001, -0.002)) - 0.5
    np.testing.assert_allclose(pixels(rig, "b.jpg", ahead), two, atol=1e-9)


def matlab_ray(u, v, a, centre, stretch):
    """MATLAB's fisheyeIntrinsics, pixels from 1: a pixel to its direction."""
    u, v = np.linalg.inv(stretch) @ (np.array([u, v]) - centre)
    r = np.hypot(u, v)
    ray = np.array([u, v, a[0] + a[1] * r**2 + a[2] * r**3 + a[3] * r**4])
    return ray / np.linalg.norm(ray)


def test_matlabs_fisheye():
    rig = read_rig(FIXTURES / "matlab_fisheye.json")
    camera = rig["camera1"]
    assert camera.hw == (480, 640)
    stretch = np.array([[1.001, 0.0005], [-0.0003, 1]])
    for x, y in ((0.0, 0.0), (320.5, 238.0), (639.0, 100.0), (50.25, 470.0)):
        expected = matlab_ray(x + 1, y + 1, (300.0, -0.0009, 4e-7, -6e-10), (321.5, 239.25), stretch)
        ray, valid = camera.rays(torch.tensor([x, y], dtype=torch.float64))
        assert valid
        np.testing.assert_allclose(ray.numpy(), expected, atol=1e-12)
        back = camera.project(torch.from_numpy(expected * 3))
        np.testing.assert_allclose(back.x.numpy(), [x, y], atol=1e-8)


def bouguet_pixels(X, fc, cc, alpha, kc):
    """project_points2.m: pixels from 0."""
    x, y = X[:, 0] / X[:, 2], X[:, 1] / X[:, 2]
    r2 = x**2 + y**2
    cdist = 1 + kc[0] * r2 + kc[1] * r2**2 + kc[4] * r2**3
    dx = 2 * kc[2] * x * y + kc[3] * (r2 + 2 * x**2)
    dy = kc[2] * (r2 + 2 * y**2) + 2 * kc[3] * x * y
    xd, yd = x * cdist + dx, y * cdist + dy
    return np.stack([fc[0] * (xd + alpha * yd) + cc[0], fc[1] * yd + cc[1]], -1)


BOUGUET = {
    "fc": [[800.0], [802.0]],
    "cc": [[320.5], [238.0]],
    "kc": [[-0.2], [0.1], [0.001], [-0.002], [0.01]],
}


def test_bouguets_results(tmp_path):
    savemat = pytest.importorskip("scipy.io").savemat

    om = np.array([[0.01], [0.1], [-0.02]])
    numbers = {f"{key}_{side}": value for key, value in BOUGUET.items() for side in ("left", "right")}
    numbers |= {
        "alpha_c_left": 0.001,
        "alpha_c_right": 0.0,
        "om": om,
        "T": [[-100.0], [2.0], [1.0]],
        "nx": 640,
        "ny": 480,
    }
    savemat(tmp_path / "Calib_Results_stereo.mat", numbers)
    rig = read_rig(tmp_path / "Calib_Results_stereo.mat")
    flat = [np.ravel(value) for value in BOUGUET.values()]
    np.testing.assert_allclose(
        pixels(rig, "left", POINTS), bouguet_pixels(POINTS, *flat[:2], 0.001, flat[2]), atol=1e-9
    )
    angle, axis = np.linalg.norm(om), np.ravel(om) / np.linalg.norm(om)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    R = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    right = POINTS @ R.T + [-0.1, 0.002, 0.001]
    np.testing.assert_allclose(
        pixels(rig, "right", POINTS), bouguet_pixels(right, *flat[:2], 0.0, flat[2]), atol=1e-9
    )
    savemat(
        tmp_path / "Calib_Results.mat", {**BOUGUET, "alpha_c": 0.0, "nx": 640, "ny": 480, "KK": np.eye(3)}
    )
    one = read_rig(tmp_path / "Calib_Results.mat")
    assert (one.names, one["camera"].hw) == (("camera",), (480, 640))
    np.testing.assert_allclose(
        pixels(one, "camera", POINTS), bouguet_pixels(POINTS, *flat[:2], 0.0, flat[2]), atol=1e-9
    )


def test_a_rotation_vector_of_no_rotation(tmp_path):
    savemat = pytest.importorskip("scipy.io").savemat

    numbers = {f"{key}_{side}": value for key, value in BOUGUET.items() for side in ("left", "right")}
    savemat(tmp_path / "a.mat", {**numbers, "om": [0, 1e300, 0], "T": [1.0, 0, 0], "nx": 640, "ny": 480})
    with pytest.raises(RigFileError, match=r"1e\+300"):
        read_rig(tmp_path / "a.mat")


def test_nerfstudios_fisheye(tmp_path):
    """OPENCV_FISHEYE is Kannala-Brandt's; pixels with the first centre at 0.5, OpenGL axes, camera->world."""
    fields = {
        "camera_model": "OPENCV_FISHEYE",
        "fl_x": 300,
        "fl_y": 301,
        "cx": 320,
        "cy": 240,
        "w": 640,
        "h": 480,
    }
    fields |= {"k1": 0.05, "k2": -0.01, "k3": 0.003, "k4": -5e-4}
    matrix = [[1, 0, 0, 0.1], [0, -1, 0, 0.2], [0, 0, -1, 0.3], [0, 0, 0, 1]]
    fields["frames"] = [{"file_path": "a.png", "transform_matrix": matrix}]
    (tmp_path / "transforms.json").write_text(json.dumps(fields))
    X = POINTS - [0.1, 0.2, 0.3]
    r = np.hypot(X[:, 0], X[:, 1])
    theta = np.arctan2(r, X[:, 2])
    radius = theta * (1 + 0.05 * theta**2 - 0.01 * theta**4 + 0.003 * theta**6 - 5e-4 * theta**8)
    expected = X[:, :2] / r[:, None] * radius[:, None] * [300, 301] + [319.5, 239.5]
    np.testing.assert_allclose(
        pixels(read_rig(tmp_path / "transforms.json"), "a.png", POINTS), expected, atol=1e-9
    )
