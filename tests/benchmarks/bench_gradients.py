"""Gradients of `fuse(differentiable=True)` beside central differences, near the right rig and off it.

    python -m tests.benchmarks.bench_gradients [DEGREES ...]

A window of the layered sample array; colour is rotated by so many degrees about its x axis (across the
baseline) or y axis (along it). The error is the mean squared one of the fused image, the depth the mean
inverse depth where confidence exceeds .7; differences are over .1 degrees either way, the median of pixels
for depth.
"""

from __future__ import annotations

import math

import torch
import tyro
from torch import Tensor
from tyro.conf import Positional

from pat import fuse, load_weights
from tests.benchmarks.printed import head
from tests.pat.layered_array import load_sample

HW, TOP, LEFT, STEP = (192, 256), 104, 192, math.radians(0.1)
AXES = {"across": (1.0, 0.0, 0.0), "along": (0.0, 1.0, 0.0)}


def rows(degrees: float) -> list[str]:
    """One row each axis: of the error and of the depth, the gradient and the difference."""
    sample, network = load_sample(), load_weights("mono-colour")
    window = (slice(None), slice(TOP, TOP + HW[0]), slice(LEFT, LEFT + HW[1]))
    images = sample.images | {"mono": sample.images["mono"][window]}
    rig, truth = sample.rig.crop("mono", TOP, LEFT, HW), sample.ground_truth[window]
    made = []
    for name, axis in AXES.items():

        def fused(
            angle: Tensor, axis: tuple[float, ...] = axis, **options: bool
        ) -> tuple[Tensor, Tensor, Tensor]:
            moved = rig.perturbed({"colour.rotation": angle * torch.tensor(axis, dtype=torch.float64)})
            frame = fuse(network, moved, images, alpha="mono", align=False, **options)
            return (frame.image - truth).square().mean(), 1 / frame.depth, frame.confidence.detach()

        angle = torch.tensor(math.radians(degrees), dtype=torch.float64, requires_grad=True)
        error, inverse, confidence = fused(angle, differentiable=True)
        around = [fused(angle.detach() + s) for s in (-STEP, STEP)]
        likely = (torch.stack([confidence, *(a[2] for a in around)]) > 0.7).all(0)
        slopes = [
            torch.autograd.grad(v, angle, retain_graph=True)[0] for v in (error, inverse[likely].mean())
        ]
        changes = [(around[1][0] - around[0][0]) / (2 * STEP)]
        changes.append((around[1][1] - around[0][1])[likely].median() / (2 * STEP))
        cells = [f"{float(v):.3g}" for pair in zip(slopes, changes) for v in pair]
        made.append(f"| {degrees:g} | {name} | {' | '.join(cells)} |")
    return made


def main(degrees: Positional[tuple[float, ...]] = (0, 0.1, 0.3)) -> None:
    """Print the table."""
    print(head("degrees | rotation | error, gradient | difference | inverse depth, gradient | difference"))
    for given in degrees:
        for row in rows(given):
            print(row, flush=True)


if __name__ == "__main__":
    tyro.cli(main)
