import pytest
import torch

from pat.lab.data import folder_pairs, middlebury_pairs
from pat.lab.data.pairs import Disparity, pair_files
from pat.media.images import write_image

READERS = [middlebury_pairs, folder_pairs]


def write(path, value=0.5, *, channels=3):
    write_image(path, torch.full((channels, 12, 16), value))


@pytest.mark.parametrize("reader", READERS)
def test_a_folder_without_pairs_is_an_error_at_once(tmp_path, reader):
    write(tmp_path / "0001_L.png")
    with pytest.raises(ValueError, match="stereo"):
        reader(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"folder[^/]*$"):
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
    (pair,) = folder_pairs(tmp_path)
    assert pair.name == name
    assert (float(pair.left.mean()), float(pair.right.mean())) == (0, 1)
    assert (pair.max_disparity, pair.disparity) == (120, None)


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


def test_a_file_that_is_missing_is_said_at_once(tmp_path):
    folder = tmp_path / "2006_third" / "Cloth"
    write(folder / "view1.png")
    for reader in (middlebury_pairs, pair_files):
        with pytest.raises(FileNotFoundError, match=r"view5\.png"):
            reader(tmp_path)
    write(folder / "view5.png")
    assert len(pair_files(tmp_path)) == 1
    with pytest.raises(FileNotFoundError, match=r"disp1\.png"):
        middlebury_pairs(tmp_path)


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


def test_a_post_occludes_what_is_beside_it():
    value = torch.full((4, 100), 10.0)
    value[:, 60:70] = 20.0
    value[0, 55] = torch.nan
    valid = torch.ones(4, 100, dtype=torch.bool)
    valid[0, 55] = False
    seen, occluded, beyond = Disparity(value, valid).regions()
    assert occluded[1:, 50:60].all() and int(occluded.sum()) == 4 * 10 - 1  # noqa: PT018
    assert beyond[:, :10].all() and not beyond[:, 10:].any()  # noqa: PT018
    assert bool((seen.int() + occluded.int() + beyond.int() == valid.int()).all())


def test_what_is_beyond_the_edge_hides_nothing_at_it():
    """Disparities of points beyond the edge are not counted on its first column."""
    value = torch.full((1, 40), 12.0)
    value[:, 10:] = 10.0
    assert not Disparity(value, value > 0).regions().occluded.any()


def test_what_is_not_known_hides_nothing_and_nothing_of_it():
    value = torch.tensor([[torch.nan, 1.0, 0.0, 3.0, torch.inf]])
    seen, occluded, beyond = Disparity(value, value.isfinite()).regions()
    assert occluded.tolist() == [[False, True, False, False, False]]
    assert seen.tolist() == [[False, False, True, True, False]]
    assert not beyond.any()
