"""Colour where beta does not see: each way to fill alone, the network's choice, the best choice possible.

    python -m tests.benchmarks.bench_unseen DATA [--half report] [--out tests/benchmarks/RESULTS_unseen.md]

PSNR (dB) by region, mean over Middlebury's pairs of one half of `experiments/evaluation/halves.yaml` in the
folder DATA, beta reduced 2x. The best choice is made with the ground truth, for each block of 16x16 pixels.
The second table is of the network's choice by the distance from what beta sees: *strength* is the factor of
the true chroma that is nearest to the chroma filled in, the *gains* are over alpha's grey image, of pairs
with 500 such pixels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from types import MethodType
from typing import Annotated, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import avg_pool2d, one_hot

from experiments.evaluation.conditions import regions_of
from experiments.evaluation.halves import of_half
from pat import load_weights
from pat.app.cli.parser import Option, script
from pat.fusion.classical import classical_fusion
from pat.lab.data.pairs import PAPER_DISPARITY, StereoPair, middlebury_pairs
from pat.lab.evaluation.protocols import MonoColourTask, mono_colour_task, rectified_fusion
from pat.lab.evaluation.tables import markdown_header, markdown_row
from pat.matching.colour_transfer import FILLS
from pat.media.colour import to_luma_chroma
from pat.networks.guided import BetaEstimate, Encoded, GuidedPAT
from tests.benchmarks.printed import print_tables

REGIONS = ("whole", "seen", "occluded", "beyond")
BLOCK = 16
"""Sides of the blocks of the best choice, pixels."""
DISTANCES = (0, 4, 12, 24, 48, 96, 192)
"""Bounds of the second table's rows, pixels."""
LEAST = 500
"""Least number of pixels of a pair for a row."""
FILL_NAMES = ("propagated", "diffused by brightness", "diffused")


def filled_by(network: GuidedPAT, fill: int | None) -> None:
    """Let a network fill in one way, the number of `BetaEstimate.choice`, and complete nothing; None: as it
    does."""
    if fill is None:
        for name in ("_fills", "blended"):
            vars(network).pop(name, None)
        return

    def alone(self: GuidedPAT, own: Encoded, alpha: Tensor, estimate: BetaEstimate) -> tuple[Tensor, ...]:
        chosen = one_hot(torch.tensor(fill), 1 + FILLS).to(estimate.choice)[:, None, None]
        return GuidedPAT._fills(
            self, own, alpha, estimate._replace(choice=(1e4 * chosen).expand_as(estimate.choice))
        )

    vars(network)["_fills"] = MethodType(alone, network)
    vars(network)["blended"] = lambda *given, complete: GuidedPAT.blended(network, *given)


def images_of(network: GuidedPAT, task: MonoColourTask) -> dict[str, Tensor]:
    """Fused images (3, H, W) by the way of filling, with the classical one."""
    given = task.alpha, task.beta, PAPER_DISPARITY
    found = {"classical": classical_fusion(*given)}
    for name, fill in (*((name, i) for i, name in enumerate(FILL_NAMES)), ("chosen", None)):
        filled_by(network, fill)
        found[name] = rectified_fusion(network)(*given).image
    found["best choice"] = best([found[name] for name in FILL_NAMES], task.ground_truth)
    return {name: image.clamp(0, 1) for name, image in found.items()}


def best(images: list[Tensor], truth: Tensor) -> Tensor:
    """Of each block that of the images which is nearest to the ground truth."""
    h, w = truth.shape[-2:]
    errors = torch.stack([(image - truth).square().mean(0) for image in images])
    of_blocks = avg_pool2d(errors, BLOCK, ceil_mode=True).argmin(0)
    which = of_blocks.repeat_interleave(BLOCK, 0).repeat_interleave(BLOCK, 1)[:h, :w]
    return torch.stack(images).gather(0, which.expand(1, 3, h, w))[0]


class Unseen(NamedTuple):
    """What is filled in at some pixels of a pair: the gain over grey in dB, how strong the colours are."""

    gain: float
    strength: float


def by_distance(
    image: Float[Tensor, "3 h w"],
    truth: Float[Tensor, "3 h w"],
    seen: Bool[Tensor, "h w"],
    known: Bool[Tensor, "h w"],
) -> dict[int, Unseen]:
    """What is filled in at known unseen pixels, by the lower bound of their distance from seen ones."""
    distance = torch.from_numpy(distance_transform_edt(~seen.numpy()))
    luma, chroma = to_luma_chroma(truth)
    filled = to_luma_chroma(image)[1]
    errors = [(each - truth).square().mean(0) for each in (image, luma.expand_as(truth))]
    found = {}
    for low, high in pairwise((*DISTANCES, math.inf)):
        at = known & (distance > low) & (distance <= high)
        if int(at.sum()) >= LEAST:
            own, grey = (float(error[at].mean()) for error in errors)
            strength = (filled * chroma).sum(0)[at].sum() / chroma.square().sum(0)[at].sum()
            found[low] = Unseen(10 * math.log10(grey / own), float(strength))
    return found


def tables(pairs: list[StereoPair]) -> tuple[list[str], list[str]]:
    """A row for each way to fill: means over the pairs that have such pixels; a row for each distance."""
    network = load_weights("mono-colour")
    assert isinstance(network, GuidedPAT)
    found: dict[str, list[dict[str, float]]] = {}
    distances: dict[int, list[Unseen]] = {low: [] for low in DISTANCES}
    for pair in pairs:
        task = mono_colour_task(pair, 2)
        images, truth, regions = images_of(network, task), task.ground_truth, regions_of(task)
        for name, image in images.items():
            error = (image - truth).square().mean(0)
            found.setdefault(name, []).append(
                {n: -10 * math.log10(float(error[at].mean())) for n, at in regions.items() if at.any()}
            )
        if "seen" in regions:
            known = regions["occluded"] | regions["beyond"]
            for low, unseen in by_distance(images["chosen"], truth, regions["seen"], known).items():
                distances[low].append(unseen)
    return list(by_fill(found)), list(by_distances(distances))


def by_fill(found: dict[str, list[dict[str, float]]]) -> Iterator[str]:
    yield from markdown_header(["unseen colour", *REGIONS]).splitlines()
    for name, rows in found.items():
        means = (np.mean([row[region] for row in rows if region in row]) for region in REGIONS)
        yield markdown_row([name, *(f"{mean:.2f}" for mean in means)])


def by_distances(found: dict[int, list[Unseen]]) -> Iterator[str]:
    yield from markdown_header(
        ["pixels from what beta sees", "pairs", "strength", "gain", "least gain"]
    ).splitlines()
    for (low, rows), high in zip(found.items(), (*DISTANCES[1:], math.inf)):
        if rows:
            label = f"over {low}" if high == math.inf else f"{low} to {high}"
            gains, strengths = zip(*rows)
            means = f"{fmean(strengths):.2f}", f"{fmean(gains):.1f} dB"
            yield markdown_row([label, str(len(rows)), *means, f"{min(gains):.1f} dB"])


def main(
    data: Annotated[Path, Option(positional=True)],
    half: Literal["tune", "report"] = "report",
    out: Path | None = None,
) -> None:
    """Print the tables of the pairs of one half."""
    pairs = list(of_half(middlebury_pairs(data / "middlebury"), half))
    print_tables("Colour where beta does not see", tables(pairs), out)


if __name__ == "__main__":
    script(main)
