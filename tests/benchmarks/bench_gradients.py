"""Gradients of `fuse(differentiable=True)` beside central differences, near the right rig and off it.

    python -m tests.benchmarks.bench_gradients [DEGREES ...]

A window of the layered sample array; colour is rotated by so many degrees about its x axis (across the
baseline), its y axis (along it) or its z axis, and moved along them, by 1 % of the baseline for each .1
degrees. The error is the mean squared one of the fused image, the depth the mean inverse depth where
confidence exceeds .7; differences are over .1 degrees, or 1 %, either way, the mean over the same pixels.
"""

from __future__ import annotations

import math
from itertools import product

import torch
import tyro
from torch import Tensor
from tyro.conf import Positional

from pat import fuse, load_weights
from tests.benchmarks.printed import head
from tests.pat.layered_array import load_sample

HW, TOP, LEFT, STEP = (192, 256), 104, 192, 0.1


def rows(degrees: float) -> list[str]:
    """One row each axis: of the error and of the depth, the gradient and the difference."""
    sample, network = load_sample(), load_weights("mono-colour")
    window = (slice(None), slice(TOP, TOP + HW[0]), slice(LEFT, LEFT + HW[1]))
    images = sample.images | {"mono": sample.images["mono"][window]}
    rig, truth = sample.rig.crop("mono", TOP, LEFT, HW), sample.ground_truth[window]
    units = {"rotation": math.radians(1), "translation": 0.1 * float(rig["colour"].centre.norm())}
    made = []
    for (kind, unit), axis in product(units.items(), range(3)):
        way = unit * torch.eye(3, dtype=torch.float64)[axis]

        def fused(
            far: Tensor, name: str = f"colour.{kind}", way: Tensor = way, **options: bool
        ) -> tuple[Tensor, Tensor, Tensor]:
            moved = rig.perturbed({name: far * way})
            frame = fuse(network, moved, images, alpha="mono", align=False, **options)
            return (frame.image - truth).square().mean(), 1 / frame.depth, frame.confidence.detach()

        far = torch.tensor(degrees, dtype=torch.float64, requires_grad=True)
        error, inverse, confidence = fused(far, differentiable=True)
        around = [fused(far.detach() + s) for s in (-STEP, STEP)]
        likely = (torch.stack([confidence, *(a[2] for a in around)]) > 0.7).all(0)
        slopes = [torch.autograd.grad(v, far, retain_graph=True)[0] for v in (error, inverse[likely].mean())]
        changes = [(around[1][0] - around[0][0]) / (2 * STEP)]
        changes.append((around[1][1] - around[0][1])[likely].mean() / (2 * STEP))
        cells = [f"{float(v):.3g}" for pair in zip(slopes, changes) for v in pair]
        made.append(f"| {degrees:g} | {kind} {'xyz'[axis]} | {' | '.join(cells)} |")
    return made


def main(degrees: Positional[tuple[float, ...]] = (0, 0.1, 0.3)) -> None:
    """Print the table."""
    print(head("degrees | motion | error, gradient | difference | inverse depth, gradient | difference"))
    for given in degrees:
        for row in rows(given):
            print(row, flush=True)


if __name__ == "__main__":
    tyro.cli(main)
