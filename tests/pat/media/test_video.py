import os

import cv2
import pytest
import torch

from pat.media.video import write_video


def frames(count, hw=(48, 65)):
    for i in range(count):
        yield torch.tensor([0.8, 0.4 + 0.05 * i, 0.1])[:, None, None].expand(3, *hw)


def test_a_video_has_all_frames_in_their_colours(tmp_path):
    write_video(tmp_path / "a.mp4", frames(7), rate=30)
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(30)
    for frame in frames(7):
        there, image = video.read()
        assert there
        assert image.shape == (48, 64, 3)
        assert abs(image[20, 20, ::-1] / 255 - frame[:, 0, 0].numpy()).max() < 0.04
    assert not video.read()[0]


def test_grey_frames_too(tmp_path):
    write_video(tmp_path / "a.mp4", [torch.full((1, 32, 32), 0.5)])
    assert cv2.VideoCapture(str(tmp_path / "a.mp4")).read()[0]


def test_what_goes_wrong_leaves_no_file(tmp_path):
    def broken():
        yield from frames(3)
        raise OSError("disk")

    with pytest.raises(OSError, match="disk"):
        write_video(tmp_path / "a.mp4", broken())
    with pytest.raises(ValueError, match="one size"):
        write_video(tmp_path / "a.mp4", [torch.zeros(3, 32, 32), torch.zeros(3, 32, 34)])
    with pytest.raises(ValueError, match="at least one"):
        write_video(tmp_path / "a.mp4", [])
    with pytest.raises(ValueError, match=r"ends in .mp4"):
        write_video(tmp_path / "a.gif", frames(2))
    assert os.listdir(tmp_path) == []
