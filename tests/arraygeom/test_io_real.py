"""Readers on the files that tools wrote for real cameras: observed points must be where the rig states."""

import bz2
import csv
import warnings
from collections import defaultdict
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from arraygeom import Camera, Rig
from arraygeom.io import RigFileWarning, read_rig
from tests.oracles import Oracle

cv2 = Oracle("cv2")


def tensor(values) -> torch.Tensor:
    return torch.as_tensor(np.asarray(values, dtype=float))


def read_quietly(path: Path, **options) -> Rig:
    """The rig, without the warnings about units and sizes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RigFileWarning)
        return read_rig(path, **options)


def errors(camera: Camera, X, observed) -> torch.Tensor:
    """Reprojection errors of valid points, in pixels."""
    projected = camera.project(tensor(X))
    assert projected.valid.float().mean() > 0.99
    return (projected.x - tensor(observed)).norm(dim=-1)[projected.valid]


def directions(camera: Camera, x: torch.Tensor) -> torch.Tensor:
    """Unit directions in the world of what pixels see."""
    rays, valid = camera.rays(x)
    assert bool(valid.all())
    rays = rays @ camera.R
    return rays / rays.norm(dim=-1, keepdim=True)


def triangulated(cameras: list[Camera], pixels: list[torch.Tensor]) -> torch.Tensor:
    """Points nearest to all rays (least squares); pixels (n, 2) for each camera."""
    A, b = 0.0, 0.0
    for camera, x in zip(cameras, pixels):
        d = directions(camera, x)
        across = torch.eye(3, dtype=torch.float64) - d[:, :, None] * d[:, None, :]
        A, b = A + across, b + across @ camera.centre
    return torch.linalg.solve(A, b)


def epipolar_errors(a: Camera, b: Camera, xa: torch.Tensor, xb: torch.Tensor) -> torch.Tensor:
    """Return pixels in b between the observed point and the nearest one of alpha's (possibly curved) epipolar
    line."""
    depths = torch.logspace(-1.5, 3, 1000, dtype=torch.float64) * (a.centre - b.centre).norm()
    X = a.centre + directions(a, xa)[:, None] * depths[:, None]
    projected = b.project(X)
    start, end = projected.x[:, :-1], projected.x[:, 1:]
    along = end - start
    u = ((xb[:, None] - start) * along).sum(-1) / along.square().sum(-1).clamp_min(1e-30)
    distance = (start + u.clamp(0, 1)[..., None] * along - xb[:, None]).norm(dim=-1)
    return torch.where(projected.valid[:, 1:] & projected.valid[:, :-1], distance, torch.inf).amin(-1)


@cache
def features(path: Path):
    return cv2.SIFT_create(3000).detectAndCompute(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), None)


def matches(a: Path, b: Path) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixels of SIFT features that are each other's nearest, and much nearer than the second."""
    (points_a, da), (points_b, db) = features(a), features(b)
    forward, back = (cv2.BFMatcher().knnMatch(*pair, k=2) for pair in ((da, db), (db, da)))
    best_back = {m.queryIdx: m.trainIdx for m, _ in back}
    good = [m for m, n in forward if m.distance < 0.7 * n.distance and best_back[m.trainIdx] == m.queryIdx]
    return tensor([points_a[m.queryIdx].pt for m in good]), tensor([points_b[m.trainIdx].pt for m in good])


def test_colmap_reprojects_to_a_quarter_pixel(shared_data):
    """Each point's mean error is the one that COLMAP wrote beside it; their median is 0.24 px."""
    folder = shared_data / "rigs" / "colmap_lund_door" / "colmap_ground_truth"
    rig = read_rig(folder)
    points = {int(f[0]): np.array(f[1:8], dtype=float) for f in rows(folder / "points3D.txt")}
    lines = [line for line in (folder / "images.txt").read_text().split("\n") if not line.startswith("#")]
    by_point = defaultdict(list)
    for head, rest in zip(lines[::2], lines[1::2]):
        seen = np.array(rest.split(), dtype=float).reshape(-1, 3)
        seen = seen[seen[:, 2] >= 0]
        found = errors(rig[head.split()[9]], [points[int(i)][:3] for i in seen[:, 2]], seen[:, :2] - 0.5)
        for i, error in zip(seen[:, 2], found.tolist()):
            by_point[int(i)].append(error)
    means = np.array([np.mean(by_point[i]) for i in points])
    assert np.median(means) == pytest.approx(0.24, abs=0.005)
    assert np.median(np.abs(means - [point[6] for point in points.values()])) < 1e-3


def rows(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines() if line and not line.startswith("#")]


def test_caliscope_reprojects_to_a_pixel(shared_data):
    folder = shared_data / "rigs" / "caliscope_4cam"
    rig = read_rig(folder / "camera_array.toml")
    corners = {}
    for row in csv.DictReader((folder / "xyz_CHARUCO.csv").open()):
        corners[row["sync_index"], row["keypoint_id"]] = [float(row[f"{axis}_coord"]) for axis in "xyz"]
    seen = defaultdict(list)
    for row in csv.DictReader((folder / "xy_CHARUCO.csv").open()):
        if X := corners.get((row["sync_index"], row["keypoint_id"])):
            seen[f"cam{row['cam_id']}"].append((X, [float(row["img_loc_x"]), float(row["img_loc_y"])]))
    medians = [float(errors(rig[name], *zip(*seen[name])).median()) for name in rig.names]
    assert medians == pytest.approx([0.91, 1.49, 1.31, 0.91], abs=0.01)


def test_fifteen_cameras_reproject_to_a_pixel(shared_data):
    folder = shared_data / "rigs" / "pycalib_gopro15"
    rig = read_quietly(folder / "output.json", hw=(2988, 5312))
    seen = defaultdict(dict)
    for line in bz2.decompress((folder / "kp.txt.bz2").read_bytes()).decode().splitlines()[1:6561]:
        camera, point, x, y = map(float, line.split())
        seen[int(point)][f"cam{int(camera)}"] = [x, y]
    found = []
    for views in list(seen.values())[::16]:
        if len(views) >= 2:
            cameras, pixels = [rig[name] for name in views], [tensor([x]) for x in views.values()]
            X = triangulated(cameras, pixels)
            found += [errors(camera, X, x) for camera, x in zip(cameras, pixels)]
    assert 0.6 < torch.cat(found).median() < 0.9


def test_transforms_agree_with_photographs(shared_data):
    folder = shared_data / "rigs" / "nerf_fox"
    rig = read_rig(folder / "transforms.json")
    found = []
    for a, b in list(pairwise(rig.names))[:3]:
        xa, xb = matches(folder / a, folder / b)
        found.append(epipolar_errors(rig[a], rig[b], xa, xb).median())
    assert torch.stack(found).median() < 0.6


def test_syntim_agrees_with_photographs(shared_data):
    folder = shared_data / "syntim"
    found = []
    for scene in ("BalMire", "Color", "Sigraph", "Serfaty"):
        images = [next(iter(sorted(folder.glob(f"{scene}{side}_O*.png")))) for side in (0, 1)]
        rig = read_rig(folder / f"cam_{scene}_g")
        pair = [
            rig[name].resize(cv2.imread(str(image)).shape[:2])
            for name, image in zip(("left", "right"), images)
        ]
        found.append(float(epipolar_errors(*pair, *matches(*images)).median()))
    assert 0.3 < np.median(found) < 1.2, found


def test_bumblebee_agrees_with_its_boards(shared_data):
    folder = shared_data / "calibration" / "bumblebee2_chess"
    rig = read_quietly(folder / "stereo.yaml", scale=1e-3)
    assert float(rig["right"].centre.norm()) == pytest.approx(0.12, abs=1e-3)
    found = []
    for left in sorted(folder.glob("left*.jpg")):
        corners = [chessboard(left), chessboard(folder / left.name.replace("left", "right"))]
        if corners[0] is not None and corners[1] is not None:
            found.append(epipolar_errors(rig["left"], rig["right"], *corners))
    assert len(found) >= 8
    assert 0.04 < torch.cat(found).mean() < 0.08


def chessboard(path: Path) -> torch.Tensor | None:
    """Inner corners, refined."""
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    found, corners = cv2.findChessboardCorners(grey, (4, 6))
    if not found:
        return None
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    return tensor(cv2.cornerSubPix(grey, corners, (5, 5), (-1, -1), stop).reshape(-1, 2))


def test_kalibr_fisheyes(shared_data):
    """The file states every pose twice, and the pair's frames show one scene: the median is 0.34 px."""
    folder = shared_data / "rigs" / "kalibr_hilti_5cam"
    path = folder / "calibration" / "calib_3_cam0-1-camchain-imucam.yaml"
    rig = read_rig(path)
    relative = rig["cam1"].cam_from_world @ rig["cam0"].cam_from_world.inverse()
    assert relative.t.tolist() == pytest.approx([0.10817339, 0.00051284, 0.00069196], abs=1e-6)
    assert float(rig["cam0"].centre.dist(rig["cam1"].centre)) == pytest.approx(0.108, abs=1e-3)
    assert rig["cam1"].distortion.model == "kannala-brandt"
    xa, xb = matches(folder / "rig_frames" / "0_0.png", folder / "rig_frames" / "0_1.png")
    assert epipolar_errors(rig["cam0"], rig["cam1"], xa, xb).median() < 0.6


def test_kitti(shared_data):
    path = shared_data / "kitti" / "raw_calib_2011_09_26" / "calib_cam_to_cam.txt"
    raw, rectified = read_rig(path), read_rig(path, format="kitti")
    assert raw["cam2"].hw == (512, 1392)
    assert rectified["cam2"].hw == (375, 1242)
    assert float(raw["cam1"].centre.norm()) == pytest.approx(0.5372, abs=1e-3)
    assert float(rectified["cam1"].centre.norm()) == pytest.approx(0.5372, abs=1e-3)
    folder = shared_data / "kitti" / "object_StereoRCNN"
    rig = read_quietly(folder / "calib.txt", hw=(375, 1242))
    xa, xb = matches(folder / "left.png", folder / "right.png")
    assert epipolar_errors(rig["cam2"], rig["cam3"], xa, xb).median() < 0.6


def test_opencv_intrinsics(shared_data):
    camera = read_rig(shared_data / "calibration" / "opencv_stereo" / "left_intrinsics.yml")["camera"]
    assert float(camera.K[0, 0]) == pytest.approx(535.9157, abs=1e-4)
    assert camera.hw == (480, 640)
    assert len(camera.distortion.coefficients) == 5


def test_rendered_views(shared_data):
    """Exact cameras of rendered views: all look at the same scene from 8 units away."""
    folder = shared_data / "rigs" / "pycalib_gopro15" / "mvs"
    for path in sorted(folder.glob("cam*.json")):
        camera = read_quietly(path)["cam0"]
        assert 7.5 < float(camera.centre.norm()) < 8.5
        assert bool(camera.project(torch.zeros(3, dtype=torch.float64)).valid)
