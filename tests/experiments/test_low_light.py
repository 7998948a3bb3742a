"""The denoisers' training runs, and what it writes denoises."""

import pytest
import torch

from experiments.low_light.training import DenoiserTraining, train_denoiser
from pat.networks.weights import load_denoiser


@pytest.mark.slow
def test_denoisers_are_trained(photos, tmp_path):
    config = DenoiserTraining(photos=(photos,), out=tmp_path / "out", steps=2, batch=2, side=32)
    made = load_denoiser(train_denoiser(config))
    found = made.band(torch.rand(1, 1, 32, 32), torch.full((1, 1, 32, 32), 0.1))
    assert found.shape[-2:] == (32, 32)
