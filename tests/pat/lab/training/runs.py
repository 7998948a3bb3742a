"""Short runs for the tests of training: small smooth photographs, a small network, small scenes."""

import csv
from pathlib import Path

import torch
from torch import Generator

from pat.lab.training.config import TrainConfig
from pat.media.images import write_image
from pat.networks.configs import PATConfig

SMALL = PATConfig(dim=4, residual=True, interpolation="bilinear")


def short_run(folder: Path, **changes) -> TrainConfig:
    """Eight steps of two groups of two scenes."""
    photos = folder / "photos"
    if not photos.exists():
        g = Generator().manual_seed(0)
        for i in range(4):
            smooth = torch.nn.functional.interpolate(
                torch.rand(1, 3, 12, 16, generator=g), (96, 128), mode="bilinear"
            )
            write_image(photos / f"{i}.png", smooth[0])
    given = {"network": SMALL, "steps": 8, "batch": 2, "groups": 2, "hw": (32, 48), "rate": 1e-2, "warmup": 2}
    given |= {"validate": 4, "save": 3, "held_out": 4, "average": 5, "cache": folder / "cache.npz"}
    return TrainConfig(photos=(photos,), **{"out": folder / "run"} | given | changes)


def losses(out: Path) -> list[list[str]]:
    """The lines of steps.csv as they are written: equal text means equal to the last bit."""
    with (out / "steps.csv").open() as file:
        return list(csv.reader(file))
