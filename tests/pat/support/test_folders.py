"""Files of a folder and of those within it."""

import os

import pytest
import torch

from pat.lab.data import folder_pairs
from pat.lab.synthesis.photos import read_photographs
from pat.media.images import write_image
from pat.support.folders import files_below


def test_links_are_followed_but_not_in_circles(tmp_path):
    (tmp_path / "data" / "scene").mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    for file in ("data/scene/a.png", "elsewhere/b.png"):
        (tmp_path / file).touch()
    (tmp_path / "data" / "link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "data" / "scene" / "back").symlink_to(tmp_path / "data")
    (tmp_path / "data" / "nowhere.png").symlink_to(tmp_path / "data" / "nowhere.png")
    found = [file.relative_to(tmp_path / "data").as_posix() for file in files_below(tmp_path / "data")]
    assert found == ["link/b.png", "scene/a.png"]


def test_stereo_pairs_behind_links_are_found(tmp_path):
    for side in ("left", "right"):
        write_image(tmp_path / "camera" / side / "1.png", torch.rand(3, 8, 8))
        (tmp_path / "pairs").mkdir(exist_ok=True)
        (tmp_path / "pairs" / side).symlink_to(tmp_path / "camera" / side)
    assert [pair.name for pair in folder_pairs(tmp_path / "pairs")] == ["1"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes in folders")
def test_a_pipe_is_no_photograph(tmp_path):
    """Reading one waits for ever."""
    os.mkfifo(tmp_path / "pipe.png")
    write_image(tmp_path / "good.png", torch.rand(3, 64, 64))
    assert len(read_photographs((tmp_path,), 64)) == 1
