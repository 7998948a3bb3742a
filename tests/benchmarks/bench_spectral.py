"""Fusion with betas of single bands: at one place, at three, with bands that are not red, green and blue.

    python -m tests.benchmarks.bench_spectral --photos DIR

Layered scenes of photographs that training holds out. The classical baseline sees red, green and blue at one
place as one colour image, and all other bands one by one. Table 2 on real pairs is `python -m
experiments evaluate --protocol table2`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Generator, Tensor

from arraygeom import Rig
from pat import fuse
from pat.app.cli.parser import script
from pat.fusion.classical import classical, classical_baseline
from pat.lab.evaluation.ablation import recorded
from pat.lab.evaluation.tables import markdown_header, markdown_row
from pat.lab.synthesis.layered import LayeredScenes
from pat.lab.synthesis.photos import PhotoBank
from pat.lab.synthesis.rig_distribution import RigDistribution
from pat.lab.training.config import TrainConfig
from pat.lab.training.lenses import Spectra
from pat.lab.training.samples import photographs
from pat.media.colour import luminance
from pat.networks.protocol import FusionNetwork
from pat.networks.weights import load_weights
from pat.support.metrics import score

HW = (240, 320)
RIGS = RigDistribution(mode="rectified", parallax=(10.0, 60.0), resolutions=(0.5,))
KINDS = {
    "red, green, blue at one place": (1, 0),
    "red, green, blue at three places": (3, 0),
    "one random band": (1, 1),
    "two random bands at one place": (1, 2),
    "four random bands at one place": (1, 4),
    "three random bands at three places": (3, 3),
}
"""Number of places, and of random bands (0 for red, green and blue)."""


def cases(
    photos: PhotoBank, count: int, seed: int, places: int, random: int
) -> Iterator[tuple[Rig, dict[str, Tensor], Tensor]]:
    """A rig, its images (alpha and one of each band) and the truth."""
    scenes = LayeredScenes(photos, replace(RIGS, betas=places), hw=HW, seed=seed)
    g = Generator().manual_seed(seed)
    for _ in range(count):
        made = scenes.sample(1, g)
        spectra = Spectra.drawn(1, random, g) if random else None
        seen = [spectra.of(image) if spectra else image for image in made.images]
        cameras = [camera[0].to(torch.float64) for camera in made.cameras]
        count = random or 3
        at = {f"band {i}": 1 + i % places for i in range(count)}
        ideal = {"alpha": luminance(made.images[0][0])} | {
            name: seen[place][0, i : i + 1] for i, (name, place) in enumerate(at.items())
        }
        near, far = (float(d) for d in made.depth_range[0])
        rig = Rig(
            {"alpha": cameras[0]} | {name: cameras[place] for name, place in at.items()}, depth=(near, far)
        )
        yield rig, recorded(ideal, g), seen[0][0]


def baseline(rig: Rig, images: dict[str, Tensor], places: int, random: int) -> Tensor:
    if places > 1 or random:
        return classical_baseline(rig, images, "alpha")
    names = rig.betas("alpha")
    one = Rig({"alpha": rig["alpha"], "colour": rig[names[0]]}, depth=rig.depth)
    return classical(
        one, {"alpha": images["alpha"], "colour": torch.cat([images[n] for n in names])}, "alpha", "colour"
    )


def row(
    made: Iterator[tuple[Rig, dict[str, Tensor], Tensor]],
    networks: dict[str, FusionNetwork],
    places: int,
    random: int,
) -> list[str]:
    found: dict[str, list[tuple[float, float]]] = {}
    for rig, images, ground_truth in made:
        answers = {"classical": baseline(rig, images, places, random)}
        for name, network in networks.items():
            if name == "mono-spectral" or len(ground_truth) == 3:
                answers[name] = fuse(images, rig, alpha="alpha", network=network).image
        for name, image in answers.items():
            found.setdefault(name, []).append(tuple(score(image.clamp(0, 1), ground_truth)))
    cells = {name: "{:.2f} / {:.4f}".format(*np.mean(values, 0)) for name, values in found.items()}
    return [cells.get(name, "") for name in ("classical", *networks)]


def main(
    photos: tuple[Path, ...],
    weights: tuple[str, ...] = ("mono-spectral", "mono-colour"),
    scenes: int = 10,
    cache: Path | None = None,
    seed: int = 9,
) -> None:
    """Print the table.

    Args:
        photos: Folders of photographs: those of the training, of which it holds some out.
        cache: File (.npz) of photographs read before, or to be written.
    """
    networks = {name: load_weights(name) for name in weights}
    _, unseen = photographs(TrainConfig(photos=photos, cache=cache))
    print(f"{scenes} layered scenes of {HW[1]} x {HW[0]}, betas of half the resolution; mean PSNR / SSIM\n")
    print(markdown_header(["bands", "classical", *networks]))
    for kind, (places, random) in KINDS.items():
        made = cases(unseen, scenes, seed, places, random)
        print(markdown_row([kind, *row(made, networks, places, random)]), flush=True)


if __name__ == "__main__":
    script(main)
