"""The paper's network trained anew with each field, and compared on scenes and photographs it has not seen.

Arms differ in their field alone: segments, rows and windows of about as many positions around the same
points, an upper bound (the true position), and a lower one (the segment of a pixel half an image away).
Weights, scenes, noise and their order are the same for all arms of a seed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import mean
from typing import NamedTuple

import torch
from torch import Tensor

from arraygeom import Epipolar, Pair, Positions, Segments
from arraygeom.fields import pinhole_track
from arraygeom.segments import clip_to_image
from pat.lab.evaluation.tables import grouped, markdown_table
from pat.lab.synthesis.rig_distribution import RigDistribution
from pat.lab.training.config import RecordingConfig, TrainConfig
from pat.lab.training.loop import train
from pat.lab.training.samples import scenes
from pat.networks.configs import PATConfig
from pat.networks.paper import PAT
from pat.networks.weights import load_weights
from pat.support.metrics import bootstrap_interval

RECIPE = TrainConfig(
    network=PATConfig(dim=8, residual=True, interpolation="bilinear", normalised=True),
    batch=2,
    hw=(48, 96),
    rate=2e-3,
    warmup=50,
    average=100,
    reuse=4.0,
    rectified=0.0,
    general_rigs=RigDistribution(
        mode="general", parallax=(20, 20), focal_ratio=(1, 1), resolutions=(1.0,), rotation=3.0
    ),
    recording=RecordingConfig(gain=0, blur=0, noise=0.6, paper=0, ideal=True),
)
"""The paper's architecture, narrow, on layered scenes of unrectified rigs."""
SIDE = 5
"""Side of a window: about as many positions as the longest segments have."""
CONTROL = "segments"
"""Arm that the others are compared with."""


@dataclass(frozen=True)
class Rows:
    """Segments turned into the row through their middle: as long, and as if the pair were rectified."""

    def __call__(self, pair: Pair, x: Tensor) -> Segments:
        """Segments in beta's pixels."""
        exact = Epipolar()(pair, x)
        middle = (exact.start + exact.end) / 2
        half = torch.stack([exact.length / 2, torch.zeros_like(exact.length)], -1)
        rows = clip_to_image(middle - half, middle + half, pair.beta.hw)
        return replace(rows, valid=rows.valid & exact.valid)


@dataclass(frozen=True)
class Windows:
    """Windows around the segments' middles."""

    def __call__(self, pair: Pair, x: Tensor) -> Positions:
        """Positions in beta's pixels."""
        exact = Epipolar()(pair, x)
        step = torch.arange(SIDE).to(x) - SIDE // 2
        window = torch.cartesian_prod(step, step)
        xy = ((exact.start + exact.end) / 2)[..., None, :] + window
        inside = ((xy >= 0) & (xy <= xy.new_tensor([pair.beta.hw[1] - 1, pair.beta.hw[0] - 1]))).all(-1)
        return Positions(torch.where(inside[..., None], xy, 0.0), inside & exact.valid[..., None])


@dataclass(frozen=True)
class Elsewhere:
    """The segment of the pixel half an image away along the row: never the right place."""

    def __call__(self, pair: Pair, x: Tensor) -> Segments:
        """Segments in beta's pixels."""
        w = pair.alpha.hw[1]
        return Epipolar()(pair, torch.stack([(x[..., 0] + w / 2) % w, x[..., 1]], -1))


@dataclass(frozen=True, eq=False)
class TruePosition:
    """The true position alone; a training sample gives the depth, (b, h, w) in metres."""

    depth: Tensor | None = None

    def of_depth(self, depth: Tensor) -> TruePosition:
        """The field of scenes whose depth is known."""
        return TruePosition(depth)

    def __call__(self, pair: Pair, x: Tensor) -> Segments:
        """Segments without length. Raises ValueError where no depth is known."""
        if self.depth is None:
            raise ValueError("the true position is known in training's scenes only")
        h, w = pair.alpha.hw
        column, row = (x[0, :, i].round().long().clamp(0, n - 1) for i, n in ((0, w), (1, h)))
        z = self.depth.to(x)[:, row, column]
        there = pinhole_track(pair, x).at(1 / z)
        at = clip_to_image(there, there, pair.beta.hw)
        return replace(at, valid=at.valid & z.isfinite())


ARMS = {
    "true position": f"{__name__}:TruePosition",
    CONTROL: "epipolar",
    "rows": f"{__name__}:Rows",
    "windows": f"{__name__}:Windows",
    "segments elsewhere": f"{__name__}:Elsewhere",
}
"""Field of each arm, by its name in a recipe."""


class Scored(NamedTuple):
    """Result of an arm on one image of a seed, and the number of positions that each pixel attended to."""

    arm: str
    seed: int
    image: int
    psnr: float
    positions: int


def compare_trained(
    config: TrainConfig,
    seeds: Iterable[int],
    *,
    batches: int = 32,
    each: Callable[[str], None] = lambda name: None,
) -> tuple[list[Scored], dict[str, Tensor]]:
    """Train each arm with each seed in a folder of its own below `config.out`, and score it.

    A run that is there is continued, or only scored. Returns the scores, and for a figure alpha's truth, each
    arm's image and its error (four times, black is none) of one scene.
    """
    rows: list[Scored] = []
    panels: dict[str, Tensor] = {}
    for seed in seeds:
        for arm, field in ARMS.items():
            folder = config.out / f"{arm.replace(' ', '-')}-{seed}"
            each(f"{arm}, seed {seed}")
            recipe = replace(config, field=field, seed=seed, out=folder)
            network = load_weights(train(recipe))
            assert isinstance(network, PAT)
            scored, shown = _scored(network, recipe, arm, batches)
            rows += scored
            panels |= {} if panels.keys() >= shown.keys() else shown
    return rows, panels


@torch.no_grad()
def _scored(
    network: PAT, recipe: TrainConfig, arm: str, batches: int
) -> tuple[list[Scored], dict[str, Tensor]]:
    """Scores of an arm on validation's scenes, and the panels of the first."""
    rows: list[Scored] = []
    panels: dict[str, Tensor] = {}
    for sample in scenes(recipe)[1](batches):
        image = network(sample.inputs).image.clamp(0, 1)
        squared = (image - sample.ground_truth).square().flatten(1).mean(1)
        for value in -10 * squared.clamp(min=1e-8).log10():
            rows.append(Scored(arm, recipe.seed, len(rows), float(value), sample.fields[0].samples))
        error = (image - sample.ground_truth)[0].abs().mean(0, keepdim=True)
        panels = panels or {
            f"{arm}: truth": sample.ground_truth[0],
            f"{arm}: fused": image[0],
            f"{arm}: error x 4": (4 * error).clamp(max=1),
        }
    return rows, panels


def trained_markdown(rows: Sequence[Scored]) -> str:
    """A line for each arm: PSNR, and the difference of each image from that of the control's."""
    control = {(row.seed, row.image): row.psnr for row in rows if row.arm == CONTROL}
    seeds = sorted({row.seed for row in rows})
    lines = []
    for arm, own in grouped(rows, "arm").items():
        off = {(row.seed, row.image): row.psnr - control[row.seed, row.image] for row in own}
        low, high = bootstrap_interval(list(off.values()))
        by_seed = [f"{mean(v for (s, _), v in off.items() if s == seed):+.2f}" for seed in seeds]
        difference = f"{mean(off.values()):+.2f} ({low:+.2f} to {high:+.2f})"
        positions = f"{mean(row.positions for row in own):.0f}"
        compared = [""] * (1 + len(seeds)) if arm == CONTROL else [difference, *by_seed]
        lines.append([arm, positions, f"{mean(row.psnr for row in own):.2f}", *compared])
    title = f"{len(control)} images"
    columns = [title, "positions", "PSNR, dB", f"minus {CONTROL} (95 %)", *(f"seed {seed}" for seed in seeds)]
    return markdown_table(columns, lines, align="l" + "r" * (len(columns) - 1))
