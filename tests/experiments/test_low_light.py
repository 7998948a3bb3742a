"""The denoisers' training runs, and what it writes denoises."""

import pytest
import torch
from skimage.data import data_dir

from experiments.low_light.training import DenoiserTraining, train_denoiser
from pat.networks.weights import load_denoiser


@pytest.mark.slow
def test_denoisers_are_trained(tmp_path):
    (tmp_path / "photos").mkdir()
    for name in ("astronaut", "coffee"):
        (tmp_path / "photos" / f"{name}.png").symlink_to(f"{data_dir}/{name}.png")
    config = DenoiserTraining(photos=(tmp_path / "photos",), out=tmp_path / "out", steps=2, batch=2, side=32)
    made = load_denoiser(train_denoiser(config))
    found = made.band(torch.rand(1, 1, 32, 32), torch.full((1, 1, 32, 32), 0.1))
    assert found.shape[-2:] == (32, 32)
