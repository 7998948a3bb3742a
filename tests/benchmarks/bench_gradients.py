"""Gradients of `fuse(differentiable=True)` beside differences, and what Gauss-Newton recovers by them.

    python -m tests.benchmarks.bench_gradients [DEGREES ...]

A window of the layered sample array; colour is rotated by so many degrees about its x axis (across the
baseline), its y axis (along it) or its z axis, and moved along them, by 1 % of the baseline for each .1
degrees. The error is the mean squared one of the fused image, the depth the mean inverse depth where
confidence exceeds .7; differences are over .1 degrees, or 1 %, either way, the mean over the same pixels.
Of the depth also by squares of 16 pixels: the regression of differences on gradients, and their correlation.

Then what is left of a wrong rig after each step of Gauss-Newton on how well beta, warped by the depth found,
agrees with alpha; 1 is .3 degrees, 2 % of the baseline, 1 % of the focal length.
"""

from __future__ import annotations

import math
from itertools import product
from typing import Annotated

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from pat import FuseSettings, fuse, load_weights
from pat.app.cli.parser import Option, script
from tests.benchmarks.printed import head
from tests.pat.fusion.recovering import jacobian, recovered
from tests.pat.layered_array import load_sample, middle_of_sample

HW, TOP, LEFT, STEP = (192, 256), 104, 192, 0.1
SQUARE = 16
WAYS = [(("rx",), 6), (("ry",), 3), (("rz",), 3), (("tx",), 3), (("ty",), 3), (("tz",), 3), (("focal",), 3)]
JOINT = [(("rz", "ty", "focal"), 4)]


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
            frame = fuse(
                images, moved, alpha="mono", network=network, settings=FuseSettings(align=False), **options
            )
            return (frame.image - truth).square().mean(), 1 / frame.depth, frame.confidence.detach()

        far = torch.tensor(degrees, dtype=torch.float64, requires_grad=True)
        error, inverse, confidence = fused(far, differentiable=True)
        around = [fused(far.detach() + s) for s in (-STEP, STEP)]
        likely = (torch.stack([confidence, *(a[2] for a in around)]) > 0.7).all(0)
        (slope,) = torch.autograd.grad(error, far, retain_graph=True)
        slopes = jacobian(inverse.flatten(), far).view(HW)
        changes = (around[1][1] - around[0][1]) / (2 * STEP)
        difference = (around[1][0] - around[0][0]) / (2 * STEP)
        figures = [slope, difference, slopes[likely].mean(), changes[likely].mean()]
        figures += _by_squares(slopes, changes, likely)
        cells = [f"{float(v):.3g}" for v in figures]
        made.append(f"| {degrees:g} | {kind} {'xyz'[axis]} | {' | '.join(cells)} |")
    return made


def _by_squares(slopes: Tensor, changes: Tensor, likely: Tensor) -> tuple[Tensor, Tensor]:
    """The regression of changes on slopes, and their correlation, by squares most of whose pixels count."""
    planes = torch.stack([slopes, changes, torch.ones_like(slopes)]).where(likely, 0.0)
    *both, share = avg_pool2d(planes[None], SQUARE)[0]
    slope, change = (plane[share > 0.5] / share[share > 0.5] for plane in both)
    return (slope * change).sum() / slope.square().sum(), torch.corrcoef(torch.stack([slope, change]))[0, 1]


def main(degrees: Annotated[tuple[float, ...], Option(positional=True)] = (0, 0.1, 0.3)) -> None:
    """Print the tables."""
    depth = "inverse depth, gradient | difference | regression | correlation"
    print(head(f"degrees | motion | error, gradient | difference | {depth}"))
    for given in degrees:
        for row in rows(given):
            print(row, flush=True)
    print("\n" + head("motion | left after each step"))
    sample, network = middle_of_sample(), load_weights("mono-colour")
    for which, steps in (*WAYS, *JOINT):
        left = recovered(network, sample.rig, sample.images, which, steps=steps)[1:]
        texts = (" ".join(f"{float(v):.2g}" for v in one) for one in left)
        print(f"| {', '.join(which)} | {'; '.join(texts)} |", flush=True)


if __name__ == "__main__":
    script(main)
