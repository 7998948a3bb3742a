import os

import cv2
import numpy as np
import pytest
import torch

from pat.media.video import read_video, write_video


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


def written_by_opencv(path, images, codec):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 25, images[0].shape[1::-1])
    for image in images:
        writer.write(image)
    writer.release()


@pytest.mark.parametrize("codec", ["mp4v", "MJPG"])
def test_a_grey_video_is_not_in_colour(tmp_path, codec):
    """MPEG-4 rounds the colour of grey to 3 counts."""
    ramp = np.repeat(np.arange(0, 255, 5, dtype=np.uint8)[None, :, None], 48, 0)
    written_by_opencv(tmp_path / "grey.avi", [ramp.repeat(3, 2)] * 2, codec)
    assert {frame.shape[0] for frame in read_video(tmp_path / "grey.avi").frames} == {1}
    red = ramp * np.array([0, 0, 1], np.uint8)
    written_by_opencv(tmp_path / "red.avi", [red] * 2, codec)
    assert {frame.shape[0] for frame in read_video(tmp_path / "red.avi").frames} == {3}


def test_what_goes_wrong_leaves_no_file(tmp_path):
    def broken():
        yield from frames(3)
        raise OSError("disk")

    with pytest.raises(OSError, match="disk"):
        write_video(tmp_path / "a.mp4", broken())
    with pytest.raises(ValueError, match="size"):
        write_video(tmp_path / "a.mp4", [torch.zeros(3, 32, 32), torch.zeros(3, 32, 34)])
    with pytest.raises(ValueError, match="2 x 2"):
        write_video(tmp_path / "a.mp4", frames(1, (1, 9)))
    with pytest.raises(ValueError, match="RGB"):
        write_video(tmp_path / "a.mp4", [torch.zeros(2, 32, 32)])
    with pytest.raises(ValueError, match="at least one"):
        write_video(tmp_path / "a.mp4", [])
    with pytest.raises(ValueError, match=r"\.mp4"):
        write_video(tmp_path / "a.gif", frames(2))
    for rate in (-3.0, 0.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="1000"):
            write_video(tmp_path / "a.mp4", frames(2), rate=rate)
    assert os.listdir(tmp_path) == []


def test_a_video_that_begins_black_keeps_its_colours(tmp_path):
    """Its first frame does not decide."""
    write_video(tmp_path / "a.mp4", [torch.zeros(3, 48, 64), *frames(2, (48, 64))])
    assert {frame.shape[0] for frame in read_video(tmp_path / "a.mp4").frames} == {3}
