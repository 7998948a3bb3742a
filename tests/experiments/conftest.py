"""Fixtures of the tests of experiments."""

from functools import partial

import pytest
import torch
from skimage.data import data_dir

from experiments.__main__ import Experiments
from pat.networks.configs import PATConfig
from pat.networks.paper import PAT


@pytest.fixture(scope="module")
def network() -> PAT:
    """A small one that matches by attention alone."""
    torch.manual_seed(0)
    made = PAT(PATConfig(dim=8, residual=True, interpolation="bilinear", normalised=True)).eval()
    return made.requires_grad_(False)


@pytest.fixture
def photos(tmp_path):
    """Two photographs in a folder: astronaut.png and coffee.png."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in ("astronaut.png", "coffee.png"):
        (folder / name).symlink_to(f"{data_dir}/{name}")
    return folder


@pytest.fixture
def refusal(refusal):
    """Return the line with which a command of the experiments refuses its arguments."""
    return partial(refusal, group=Experiments)
