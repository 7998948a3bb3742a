import numpy as np
import pytest
import torch

from pat.data import flickr_pairs, folder_pairs, kitti_pairs, middlebury_pairs, syntim_pairs
from pat.media.images import write_image

READERS = [middlebury_pairs, kitti_pairs, flickr_pairs, folder_pairs, syntim_pairs]


def write(path, value=0.5, *, channels=3):
    write_image(path, torch.full((channels, 12, 16), value))


@pytest.mark.parametrize("reader", READERS)
def test_a_folder_without_pairs_is_an_error_at_once(tmp_path, reader):
    write(tmp_path / "0001_L.png")
    with pytest.raises(ValueError, match="holds no stereo pair"):
        reader(tmp_path)
    with pytest.raises(FileNotFoundError, match="no such folder"):
        reader(tmp_path / "nothing")


@pytest.mark.parametrize(
    ("left", "right", "name"),
    [
        ("train/0001_L.png", "train/0001_R.png", "train/0001"),
        ("chair01_left.jpg", "chair01_right.jpg", "chair01"),
        ("a/left.png", "a/right.png", "a"),
        ("image_2/000003.png", "image_3/000003.png", "000003"),
        ("training/colored_0/01_10.png", "training/colored_1/01_10.png", "training/01_10"),
        ("Adirondack/im0.png", "Adirondack/im1.png", "Adirondack"),
        ("left.png", "right.png", "left"),
        ("left/x/left/a.png", "left/x/right/a.png", "x/a"),
    ],
)
def test_pairs_are_found_by_their_names(tmp_path, left, right, name):
    write(tmp_path / left, 0.0)
    write(tmp_path / right, 1.0)
    (pair,) = folder_pairs(tmp_path, max_disparity=30.0)
    assert pair.name == name
    assert (float(pair.left.mean()), float(pair.right.mean())) == (0, 1)
    assert (pair.max_disparity, pair.disparity, pair.calibration) == (30, None, None)


def test_middlebury_disparities_are_scaled_by_the_collection(tmp_path):
    folder = tmp_path / "2006_third" / "Cloth"
    write(folder / "view1.png")
    write(folder / "view5.png")
    write_image(folder / "disp1.png", torch.tensor([[[0.0, 30.0, 255.0]]]) / 255)
    (pair,) = middlebury_pairs(tmp_path)
    assert pair.name == "2006_third/Cloth"
    torch.testing.assert_close(pair.disparity.value, torch.tensor([[0.0, 10.0, 85.0]]))
    assert pair.disparity.valid.tolist() == [[False, True, True]]
    assert pair.max_disparity == 85


def test_kitti_calibration_is_relative_to_left(tmp_path):
    write(tmp_path / "left.png")
    write(tmp_path / "right.png")
    K, t = np.array([[700.0, 0, 600], [0, 700, 170], [0, 0, 1]]), np.array([0.06, 0.001, 0.002])
    rows = [
        f"P{k}: " + " ".join(map(str, (K @ np.c_[np.eye(3), x]).ravel()))
        for k, x in enumerate((t, t, t, t - [0.5, 0, 0]))
    ]
    (tmp_path / "calib.txt").write_text("\n".join(rows))
    (pair,) = kitti_pairs(tmp_path)
    torch.testing.assert_close(pair.calibration.t, torch.tensor([-0.5, 0, 0]), atol=1e-6, rtol=0)
    torch.testing.assert_close(pair.calibration.K_left, torch.tensor(K).float())


SYNTIM = """Intrinsic parameters:
Image center: u0 = {0:.6f}, v0 = 7.000000
Scale factor:
au = 100.000000, av = 110.000000
Image size: dimx = 16, dimy = 12
Focale: 1.0
Extrinsic parameters:
Rotation:
{{{{{1:.6f}, {2:.6f}, {3:.6f}}},
 {{{4:.6f}, {5:.6f}, {6:.6f}}},
 {{{7:.6f}, {8:.6f}, {9:.6f}}}}}
Translation:
{{{10:.6f}, {11:.6f}, {12:.6f}}}
"""


def turn(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def test_syntim_cameras_are_relative_to_left_and_in_metres(tmp_path):
    poses = [(turn(0.3), np.array([-500.0, 20, 100])), (turn(-0.2), np.array([400.0, 0, 150]))]
    for side, number, (R, t) in zip("gd", "01", poses):
        write(tmp_path / f"Cube{number}_OG0.png")
        (tmp_path / f"cam_Cube_{side}").write_text(SYNTIM.format(8.5, *R.ravel(), *t))
    (pair,) = syntim_pairs(tmp_path)
    assert pair.name == "Cube_OG0"
    world = np.array([30.0, -40, 2000])
    in_left, in_right = (R.T @ (world - t) / 1000 for R, t in poses)
    K_left, _, R, t = (x.double().numpy() for x in pair.calibration)
    np.testing.assert_allclose(R @ in_left + t, in_right, atol=1e-5)
    np.testing.assert_allclose(K_left, [[100, 0, 8.5], [0, 110, 7], [0, 0, 1]])


def test_a_damaged_syntim_calibration_is_named(tmp_path):
    for number in "01":
        write(tmp_path / f"Cube{number}_OG0.png")
    with pytest.raises(FileNotFoundError, match="cam_Cube_g"):
        next(syntim_pairs(tmp_path))
    (tmp_path / "cam_Cube_g").write_text("u0 = 1.5")
    with pytest.raises(ValueError, match=r"cam_Cube_g: has 1 decimal numbers, wanted 17"):
        next(syntim_pairs(tmp_path))


def test_true_disparity_takes_left_to_right(shared_data):
    """Looking right up at x - disparity resembles left; at x + disparity, or at half of it, it does not."""
    teddy, tsukuba = (
        next(pair for pair in middlebury_pairs(shared_data / "middlebury") if key in pair.name)
        for key in ("teddy", "tsukuba")
    )
    for pair in (teddy, tsukuba):
        errors = {scale: warping_error(pair, scale) for scale in (1, -1, 0.5, 2)}
        assert errors[1] < 0.6 * min(errors[scale] for scale in (-1, 0.5, 2)), errors


def warping_error(pair, scale):
    rows, columns = torch.where(pair.disparity.valid)
    found = (columns - scale * pair.disparity.value[rows, columns]).round().long()
    inside = (found >= 0) & (found < pair.right.shape[2])
    difference = pair.left[:, rows, columns] - pair.right[:, rows, found.clamp(0, pair.right.shape[2] - 1)]
    return float(difference[:, inside].abs().median())
