"""Which files of several cameras are of one frame."""

import warnings
from pathlib import Path

import pytest

from pat.app.frame_matching import MissingFramesWarning, matched_frames, warn_of_gaps


def files(**names):
    return {camera: [Path(camera, f"{name}.png") for name in stems] for camera, stems in names.items()}


def stems(matched):
    return {camera: [path.stem for path in paths] for camera, paths in matched.items()}


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (["1", "2", "10"], ["1", "2", "10"]),
        (["m_1", "m_2", "m_10"], ["c_1", "c_2", "c_10"]),
        (["cam0_0001", "cam0_0002"], ["cam1_0001", "cam1_0002"]),
        (["run1_1", "run1_2", "run2_1"], ["1_1", "1_2", "2_1"]),
        (["mono kitchen", "mono garden"], ["colour kitchen", "colour garden"]),
        (["12.001", "12.034", "12.067"], ["12.002", "12.035", "12.066"]),
        (["1403636579763555584", "1403636579813555456"], ["1403636579763555999", "1403636579813555000"]),
    ],
)
def test_frames_that_are_all_there_are_matched_without_a_word(a, b):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert stems(matched_frames(files(a=a, b=b))) == {"a": a, "b": b}


@pytest.mark.parametrize(("prefix_a", "prefix_b"), [("", ""), ("m_", "c_"), ("cam0_", "cam1_")])
def test_a_frame_that_a_camera_lacks_shifts_none(prefix_a, prefix_b):
    """Equally many files are not paired one by one, which would fuse 2 with 1 and 3 with 2."""
    a = [f"{prefix_a}{i}" for i in (0, 2, 3, 4)]
    b = [f"{prefix_b}{i}" for i in (0, 1, 2, 4)]
    said = rf"'a' has none of {prefix_b}1; 'b' has none of {prefix_a}3: 3 of 5"
    with pytest.warns(MissingFramesWarning, match=said):
        found = stems(matched_frames(files(a=a, b=b)))
    assert found == {"a": [f"{prefix_a}{i}" for i in (0, 2, 4)], "b": [f"{prefix_b}{i}" for i in (0, 2, 4)]}


def test_a_time_without_another_near_it_is_missing():
    with pytest.warns(MissingFramesWarning, match=r"'b' .*10\.5"):
        found = stems(matched_frames(files(a=["10.0", "10.5", "11.0", "11.5"], b=["10.1", "11.1", "11.6"])))
    assert found == {"a": ["10.0", "11.0", "11.5"], "b": ["10.1", "11.1", "11.6"]}


def test_frames_that_nothing_relates_are_taken_in_order_and_that_is_said():
    with pytest.warns(MissingFramesWarning, match="taken in order"):
        found = stems(matched_frames(files(a=["1", "2"], b=["x", "y"])))
    assert found == {"a": ["1", "2"], "b": ["x", "y"]}
    with pytest.raises(ValueError, match="2 of 'a', 3 of 'b'"):
        matched_frames(files(a=["1", "2"], b=["x", "y", "z"]))


def test_names_that_repeat_within_a_camera_relate_nothing():
    """A folder of each scene: two files of one name are two frames, and none is lost."""
    given = {name: [Path(name, scene, "image.png") for scene in ("kitchen", "garden")] for name in "ab"}
    with pytest.warns(MissingFramesWarning, match="taken in order"):
        assert matched_frames(given) == given


def test_many_missing_frames_are_not_all_listed():
    with pytest.warns(MissingFramesWarning, match="1, 3, 5, 7, 9"):
        matched_frames(files(a=map(str, range(20)), b=map(str, range(0, 20, 2))))


def test_a_gap_in_a_sequence_is_said():
    with pytest.warns(MissingFramesWarning, match=r"'a'.*2\.png"):
        warn_of_gaps(files(a=["0", "1", "2", "4", "5"], b=["0", "1", "2"]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_gaps(files(a=["0", "2", "4", "6"], b=["kitchen", "garden"]))


def test_one_frame_of_a_camera_has_no_gap():
    """A sequence of many fast frames and one slow one."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_gaps(files(fast=["fast_0", "fast_1", "fast_2"], slow=["slow_0"]))
    assert len(matched_frames(files(a=["a_0"], b=["b_7"]))["a"]) == 1
