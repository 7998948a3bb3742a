"""What random rigs are worth in training: weights from one rig and from random ones, on many kinds.

    python -m tests.benchmarks.bench_rigs --single runs/mono-colour-single-rig/best.safetensors

Rigs differ in how hard they are, so what counts is how far weights stay ahead of the classical baseline, on
the same scenes: `lost` is how much less that is than on the rig that the single-rig recipe was trained on.
Scenes whose cameras look along their baseline are left out, because nothing rectifies them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import tyro

from pat.evaluation.ablation import ALPHA, BETA, AblationCase, layered_cases
from pat.evaluation.baseline import classical
from pat.evaluation.metrics import bootstrap_interval, score
from pat.evaluation.tables import markdown_header, markdown_row
from pat.fusion.fuse import fuse
from pat.networks.protocol import FusionNetwork
from pat.networks.weights import load_weights
from pat.synthesis.rig_distribution import RigDistribution
from pat.training.config import load_config
from tests.benchmarks.printed import print_tables

SINGLE = load_config("mono-colour-single-rig").rectified_rigs
GENERAL = replace(
    SINGLE, mode="general", focal_ratio=(1.0, 1.0), rotation=0.0, toe_in=(0.0, 0.0), decentring=0.0
)
RIGS: dict[str, RigDistribution] = {
    "the single rig": SINGLE,
    "twice the baseline": replace(SINGLE, parallax=(80.0, 80.0)),
    "a quarter of the baseline": replace(SINGLE, parallax=(10.0, 10.0)),
    "alpha on the right": replace(SINGLE, alpha="right"),
    "beta as sharp as alpha": replace(SINGLE, resolutions=(1.0,)),
    "beta four times coarser": replace(SINGLE, resolutions=(0.25,)),
    "depths to 40 times the nearest": replace(SINGLE, depth_ratio=(40.0, 40.0)),
    "baseline in any direction": GENERAL,
    "turned, toed in": replace(GENERAL, rotation=6.0, toe_in=(0.0, 1.0), decentring=0.1),
    "focal lengths 2 : 1": replace(GENERAL, rotation=6.0, focal_ratio=(0.5, 0.5), resolutions=(1.0,)),
    "focal lengths 3 : 1": replace(GENERAL, rotation=6.0, focal_ratio=(1 / 3, 1 / 3), resolutions=(1.0,)),
}


def ahead(networks: dict[str, FusionNetwork], case: AblationCase) -> dict[str, float] | None:
    """By how many dB each leads the classical baseline; and its PSNR. None if nothing rectifies."""
    try:
        base = score(classical(case.rig, case.images, ALPHA, BETA), case.ground_truth).psnr
    except ValueError:
        return None
    fused = {
        name: fuse(net, case.rig, case.images, alpha=ALPHA).image.clamp(0, 1)
        for name, net in networks.items()
    }
    return {"classical": base} | {
        name: score(image, case.ground_truth).psnr - base for name, image in fused.items()
    }


def lines(networks: dict[str, FusionNetwork], scenes: int, photos: tuple[Path, ...]) -> Iterator[str]:
    yield (f"{scenes} layered scenes of 240 x 320 a row; PSNR in dB, ahead of classical; [95% interval].\n")
    yield markdown_header(
        ["rig", "classical", *(cell for name in networks for cell in (f"{name} rigs", "lost"))]
    )
    reference: dict[str, float] = {}
    for kind, rigs in RIGS.items():
        cases = layered_cases(scenes, photos=photos, rigs=rigs, seed=7)
        found = [figures for case in cases if (figures := ahead(networks, case)) is not None]
        cells = [kind, f"{np.mean([f['classical'] for f in found]):.2f}"]
        for name in networks:
            values = [f[name] for f in found]
            mean, (low, high) = float(np.mean(values)), bootstrap_interval(values)
            lost = reference.setdefault(name, mean) - mean
            cells += [f"{mean:+.2f} [{low:+.2f}, {high:+.2f}]", f"{lost:+.2f}"]
        yield markdown_row(cells)


def main(
    single: str,
    random: str = "mono-colour-small",
    scenes: int = 16,
    photos: tuple[Path, ...] = (),
    out: Path | None = None,
) -> None:
    """Print the table.

    Args:
        single: Weights trained on the single rig.
        random: Weights trained as long on random rigs.
        photos: Folders of photographs; scikit-image's if none is given.
    """
    networks = {"random": load_weights(random), "single": load_weights(single)}
    print_tables("Weights of one rig, weights of random rigs", [lines(networks, scenes, photos)], out)


if __name__ == "__main__":
    tyro.cli(main)
