"""The showcase, on a small folder laid out as the real one, whose scenes are known."""

import json
import shutil

import cv2
import numpy as np
import pytest
import torch

from arraygeom import (
    Camera,
    Pose,
    Rig,
    apply_homography,
    epipolar_distance,
    intrinsics,
    plane_homography,
    shift_origin,
)
from arraygeom import rotation_from_vector as rotation
from experiments.__main__ import Experiments
from experiments.showcase import SLOW, SYNTIM, published_matrices, showcase
from pat.app.cli.main import Pat, main
from pat.media.images import read_image, write_image
from pat.networks.guided import GuidedPAT
from pat.networks.weights import save_weights

SYNTIM_HW, FAST_HW, SLOW_HW = (120, 160), (208, 272), (160, 240)
PLANE = 2.0
"""Depth in metres of what the SYNTIM stand-in sees."""


def texture(hw, seed=0):
    """Colours (3, H, W) in blobs of many sizes."""
    noise = np.random.default_rng(seed).standard_normal((*hw, 3)).astype(np.float32)
    image = sum(cv2.GaussianBlur(noise, (0, 0), s) * s for s in (1.2, 2.5, 5))
    return torch.from_numpy(((image - image.min()) / np.ptp(image)).transpose(2, 0, 1).copy())


def moved(image, H, hw):
    """The image in another camera, x' ~ H x."""
    planes = np.ascontiguousarray(image.movedim(0, -1).numpy())
    warped = cv2.warpPerspective(
        planes, np.asarray(H), hw[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    return torch.from_numpy(np.atleast_3d(warped)).movedim(-1, 0).clamp(0, 1)


def write_pair(left, right, *, disparity=4, seed=0):
    image = texture((48, 64 + disparity), seed)
    write_image(left, image[..., :-disparity])
    write_image(right, image[..., disparity:])


def syntim_rig() -> Rig:
    R = rotation(torch.tensor([0.02, -0.06, 0.03], dtype=torch.float64))
    poses = {"left": Pose.identity(), "right": Pose.from_centre(R, R.new_tensor([0.1, 0.01, 0]))}
    return Rig(
        {
            name: Camera(K=intrinsics(200.0, SYNTIM_HW), cam_from_world=pose, hw=SYNTIM_HW)
            for name, pose in poses.items()
        }
    )


def syntim_text(camera: Camera) -> str:
    """X_cam = R^T (X - t), millimetres."""
    rows = ", ".join("{" + ", ".join(f"{v:.9f}" for v in row) + "}" for row in camera.R.T.tolist())
    t = ", ".join(f"{1000 * v:.6f}" for v in camera.centre.tolist())
    K, (h, w) = camera.K, camera.hw
    return (
        f"Intrinsic parameters:\nImage center: u0 = {K[0, 2]:.6f}, v0 = {K[1, 2]:.6f}\nScale factor: \n"
        f"au = {K[0, 0]:.6f}, av = {K[1, 1]:.6f}\nImage size: dimx = {w}, dimy = {h}\nFocale: 1.0\n"
        f"Extrinsic parameters:\nRotation:\n{{{rows}}}\nTranslation:\n{{{t}}}\n"
    )


def write_syntim(folder):
    rig = syntim_rig()
    pair = rig.pair("left", "right")
    a, b = pair.cameras
    pose = pair.beta_from_alpha
    normal, d = torch.tensor([0.0, 0, 1], dtype=torch.float64), torch.tensor(-PLANE, dtype=torch.float64)
    H = plane_homography(a.K, b.K, pose.R, pose.t, normal=normal, d=d)
    left = texture(SYNTIM_HW)
    write_image(folder / f"{SYNTIM}0_OG0.png", left)
    write_image(folder / f"{SYNTIM}1_OG0.png", moved(left, H, SYNTIM_HW))
    (folder / f"cam_{SYNTIM}_g").write_text(syntim_text(rig["left"]))
    (folder / f"cam_{SYNTIM}_d").write_text(syntim_text(rig["right"]))


def slow_map(k: int) -> torch.Tensor:
    return torch.tensor([[0.74, 0.02, 25.0 + 3 * k], [-0.02, 0.74, 8.0 - k], [0, 0, 1]], dtype=torch.float64)


def slow_F(k: int) -> torch.Tensor:
    """F = [e]x H for an epipole far to the left."""
    x, y, z = -900.0, 60.0 * k, 1.0
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return cross @ slow_map(k)


def write_fast_slow(folder):
    """Files count pixels from 1."""
    scene = texture(FAST_HW, 7)
    write_image(folder / "pillow_1" / "141.png", 0.4 * scene.mean(0, keepdim=True))
    published = {}
    for k, (name, key) in enumerate(SLOW.items()):
        write_image(
            folder / "pillow_1" / f"{name}_4.png",
            moved(0.2 * scene[k : k + 1] + 0.8 * scene.mean(0, keepdim=True), slow_map(k), SLOW_HW),
        )
        published[key] = shift_origin(slow_F(k), -1.0).tolist()
    (folder / "fundamental_matrices.json").write_text(json.dumps({"pillow": published}))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """The whole folder, and weights of a small network."""
    root = tmp_path_factory.mktemp("data")
    write_pair(root / "kitti" / "left.png", root / "kitti" / "right.png")
    scene = root / "middlebury" / "2006_third" / "Wood"
    write_pair(scene / "view1.png", scene / "view5.png", seed=1)
    write_image(scene / "disp1.png", torch.full((1, 48, 64), 12 / 255))
    write_pair(root / "flickr1024" / "0001_L.png", root / "flickr1024" / "0001_R.png", seed=2)
    (root / "syntim").mkdir()
    write_syntim(root / "syntim")
    write_fast_slow(root / "hfr_lfr")
    torch.manual_seed(0)
    save_weights(GuidedPAT(), root / "small.safetensors")
    return root


@pytest.fixture(scope="module")
def shown(data, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    return showcase(data, out, str(data / "small.safetensors"), rates=(2,)), out


def test_every_case_has_its_table_and_its_figure(shown):
    text, out = shown
    assert (out / "showcase.md").read_text() == text
    tables = "#### kitti", "#### middlebury", "#### flickr1024", "| Serfaty |", "| cam3 |", "SSIM of fusion"
    assert all(expected in text for expected in tables)
    figures = [line[line.index("(") + 1 : -1] for line in text.splitlines() if line.startswith("![")]
    assert figures == ["syntim_Serfaty.png", "fast_slow.png"]
    assert all(read_image(out / figure).shape[0] == 3 for figure in figures)
    assert {p.name for p in (out / "pairs").rglob("*.png")} >= {"0001_x2.png"}


def test_the_calibrated_rig_is_the_one_of_the_files_with_depths_around_the_plane(shown):
    rig, wanted = Rig.load(shown[1] / "syntim_Serfaty.yaml"), syntim_rig()
    for name in ("left", "right"):
        torch.testing.assert_close(rig[name].K, wanted[name].K, atol=1e-5, rtol=0)
        torch.testing.assert_close(rig[name].R, wanted[name].R, atol=1e-7, rtol=0)
        torch.testing.assert_close(rig[name].t, wanted[name].t, atol=1e-7, rtol=0)
    near, far = rig.depth
    assert 0.7 * PLANE < near < PLANE < far < 1.6 * PLANE


def test_published_matrices_are_brought_to_our_pixels(data):
    for k, F in enumerate(published_matrices(data / "hfr_lfr" / "fundamental_matrices.json").values()):
        torch.testing.assert_close(F, slow_F(k))


def test_a_file_without_the_matrices_is_named(tmp_path):
    (tmp_path / "f.json").write_text('{"pillow": {}}')
    with pytest.raises(ValueError, match=r"f\.json: "):
        published_matrices(tmp_path / "f.json")


def test_the_links_are_in_our_pixels(shown):
    """Points of the scene, put through the maps it was made with, lie on the lines and near H x."""
    rig = Rig.load(shown[1] / "fast_slow.yaml")
    x = torch.tensor([[60.0, 50], [120, 100], [150, 60], [80, 120]], dtype=torch.float64)
    for k, name in enumerate(SLOW):
        pair = rig.pair("fast", name)
        y = apply_homography(slow_map(k), x).x
        assert epipolar_distance(pair.fundamental, x, y).abs().max() < 0.4
        assert (apply_homography(pair.homography, x).x - y).norm(dim=-1).max() < 1.5


@pytest.mark.parametrize("missing", ["syntim", "hfr_lfr/fundamental_matrices.json", "kitti/right.png"])
def test_what_is_missing_is_named(data, tmp_path, refusal, missing):
    folder = tmp_path / "data"
    shutil.copytree(data, folder)
    gone, given = folder / missing, ["--data", str(folder), "--out", str(tmp_path / "out")]
    shutil.rmtree(gone) if gone.is_dir() else gone.unlink()
    assert missing.split("/")[0] in refusal("showcase", *given, "--network", data / "small.safetensors")
    assert not (tmp_path / "out").exists()


def test_evaluate_writes_and_prints_the_tables(data, tmp_path, capsys):
    given = ["--kitti", str(data / "kitti"), "--rates", "2", "--out", str(tmp_path)]
    main(["lab", "evaluate", *given, "--network", str(data / "small.safetensors")])
    printed = capsys.readouterr().out
    assert printed == (tmp_path / "scores.md").read_text()
    assert printed.startswith("#### kitti\n\n| beta reduced 2x | alpha | beta | classical | fusion |\n")
    header, *rows = (tmp_path / "scores.csv").read_text().splitlines()
    assert header.startswith("set,pair,rate,")
    assert len(rows) == 4
    assert all(row.startswith("kitti,") for row in rows)
    assert len(list((tmp_path / "kitti").glob("*_x2.png"))) == 1


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "give at least one of --kitti"),
        (["--kitti", "nowhere"], "nowhere: no such folder"),
        (["--kitti", ".", "--rates", "0"], "--rates: 0"),
    ],
)
def test_evaluate_says_what_is_wrong(arguments, complaint, tmp_path, refusal):
    assert complaint in refusal("lab", "evaluate", *arguments, "--out", str(tmp_path / "out"), group=Pat)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (
            ["evaluate", "--kitti", ".", "--without-rig", "--protocol", "table2"],
            "--without-rig needs --protocol table1",
        ),
        (
            ["conditions", "--kitti", ".", "--only", "dusk"],
            "--only: no condition 'dusk': there are ideal, x1",
        ),
        (
            ["conditions", "--kitti", "DATA/kitti", "--half", "tune"],
            "--half tune",
        ),
        (["outside", "--kitti", "DATA/kitti"], "none of its pairs has a true disparity"),
        (["certainty", "--middlebury", ".", "--conditions", "dusk"], "--conditions: no condition 'dusk'"),
    ],
)
def test_the_tables_commands_say_what_is_wrong(arguments, complaint, data, tmp_path, refusal):
    given = [argument.replace("DATA", str(data)) for argument in arguments]
    assert complaint in refusal(*given, "--out", str(tmp_path / "out"))


def test_the_papers_figures_are_beside_ours(data, tmp_path, capsys):
    given = ["--kitti", str(data / "kitti"), "--rates", "2", "--controls", "--out", str(tmp_path)]
    main(["evaluate", *given, "--network", "mono-colour"], group=Experiments)
    printed = capsys.readouterr().out
    assert printed == (tmp_path / "scores.md").read_text()
    assert "| shuffled fields | the paper, printed, on its own data |" in printed
    assert "29.55 / 0.9097" in printed
    assert printed.count(" dB against fusion, ") == 3
