"""Pairs with true disparity as samples: what is said of positions and occlusion holds in the images."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from arraygeom import sample
from pat.lab.training.config import RecordingConfig, TrainConfig
from pat.lab.training.samples import degraded, scenes
from pat.lab.training.stereo import MeasuredPairs

HW, NEAR, FAR = (32, 48), 9, 3
"""Disparities of a square and of what is behind it."""


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """A random texture with a square of another in front, as the left and the right camera see it."""
    folder = tmp_path_factory.mktemp("2006_third") / "made"
    folder.mkdir()
    r = np.random.RandomState(0)
    behind, front = (
        np.kron(r.randint(0, 256, (24, 40, 3)), np.ones((2, 2, 1))).astype(np.uint8) for _ in range(2)
    )
    for image, disparity, shift in (("view1.png", "disp1.png", 0), ("view5.png", "disp5.png", 1)):
        pixels, known = np.roll(behind, -shift * FAR, 1), np.full(behind.shape[:2], 3 * FAR, np.uint8)
        square = slice(12, 36), slice(30 - shift * NEAR, 54 - shift * NEAR)
        pixels[square], known[square] = front[12:36, 30:54], 3 * NEAR
        known[:4] = 0  # the first rows are not known
        Image.fromarray(pixels).save(folder / image)
        Image.fromarray(known).save(folder / disparity)
    return folder


def test_true_positions_are_where_beta_shows_the_same(pair):
    crops = MeasuredPairs([pair], hw=HW)
    shown = hidden = 0
    for number in range(6):
        g = torch.Generator().manual_seed(number)
        scene = crops.sample(2, g, number=number)
        made = degraded(scene, g, recording=RecordingConfig(gain=0, blur=0, noise=0, paper=0))
        there = sample(made.betas[0], made.position[0].float()).values
        off = (there - made.ground_truth).abs().amax(1)
        known = (made.position[0] != 0).any(-1)
        occluded = (
            known
            & ~made.visible[0]
            & (made.position[0][..., 0] >= 0)
            & (made.position[0][..., 0] < HW[1] - 1)
        )
        assert (off[made.visible[0]] < 0.02).float().mean() > 0.99
        unknown = ~known
        unknown[:, 0, FAR] = False  # may be seen at (0, 0), which stands for unknown elsewhere
        assert not made.visible[0][unknown].any()
        shown, hidden = shown + int(made.visible[0].sum()), hidden + int(occluded.sum())
        if occluded.any():
            assert (off[occluded] > 0.02).float().mean() > 0.9
    assert shown > 5000
    assert hidden > 100


def test_pairs_without_the_disparity_of_both_images_are_refused(pair, tmp_path):
    folder = tmp_path / "2006_third" / "half"
    folder.mkdir(parents=True)
    for name in ("view1.png", "view5.png", "disp1.png"):
        (folder / name).write_bytes((pair / name).read_bytes())
    with pytest.raises(ValueError, match=r"disp5\.png"):
        MeasuredPairs([folder], hw=HW)


def test_pairs_whose_folder_does_not_tell_the_scale_are_refused(pair, tmp_path):
    folder = shutil.copytree(pair, tmp_path / "aloe")
    with pytest.raises(ValueError, match="scale of the disparities"):
        MeasuredPairs([folder], hw=HW)


def test_a_recipe_takes_its_batches_from_them(pair):
    config = TrainConfig(measured=1.0, measured_from=(pair.parent,), hw=HW, batch=1, held_out=2)
    with pytest.raises(ValueError, match="too few"):  # one pair cannot be learned from and held out
        scenes(config)


def test_an_image_beyond_pillows_limit_is_named(pair, monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    with pytest.raises(ValueError, match=r"\.png"):
        MeasuredPairs([pair], hw=HW)
