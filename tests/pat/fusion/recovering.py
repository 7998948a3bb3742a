"""A rig recovered from images alone: Gauss-Newton on how well beta, warped by the depth found, agrees."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from arraygeom import Pair, Rig
from arraygeom.multiview import warp
from pat import FuseSettings, fuse
from pat.media.colour import luminance
from pat.networks.protocol import FusionNetwork

UNITS = {"rx": 0.3, "ry": 0.3, "rz": 0.3, "tx": 0.02, "ty": 0.02, "tz": 0.02, "focal": 0.01}
"""By how much `moved` moves colour for each 1: degrees about its axes, shares of the baseline, of the focal
length."""


def moved(rig: Rig, which: Sequence[str], by: Tensor) -> Rig:
    """The rig with colour moved in some ways of `UNITS`."""
    change = dict.fromkeys(UNITS, by.new_zeros(())) | dict(zip(which, by))
    steps = {name: unit * change[name] for name, unit in UNITS.items()}
    rotation, translation = (torch.stack([steps[kind + axis] for axis in "xyz"]) for kind in "rt")
    lengths = rig["colour"].centre.norm(), rig["colour"].K.diagonal()[:2]
    changes = [math.radians(1) * rotation, translation * lengths[0], steps["focal"] * lengths[1]]
    names = ("rotation", "translation", "focal")
    return rig.perturbed({f"colour.{name}": way for name, way in zip(names, changes)})


def rotated(rig: Rig, angle: Tensor) -> Rig:
    """The rig, colour rotated about its x axis, across the baseline."""
    return rig.perturbed({"colour.rotation": angle * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)})


def rotation_left(error_of: Callable[[Tensor], Tensor]) -> float:
    """Degrees that are left of 0.3 after ten steps downhill of an error, which is a function of the angle."""
    angle = torch.tensor(math.radians(0.3), dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.Rprop([angle], lr=math.radians(0.13), etas=(0.3, 1.01))
    for _ in range(10):
        optimiser.zero_grad()
        error_of(angle).backward()
        optimiser.step()
    return math.degrees(angle.item())


def residuals(network: FusionNetwork, rig: Rig, images: dict[str, Tensor]) -> Tensor:
    """Colour's luminance where the depth found says that alpha's pixels are, minus alpha; 0 where unsure."""
    frame = fuse(
        images, rig, alpha="mono", network=network, settings=FuseSettings(align=False), differentiable=True
    )
    colour, pair = luminance(images["colour"])[None].double(), Pair(rig["mono"], rig["colour"])
    seen, valid = warp(pair, colour, frame.depth[None].double(), interpolation="bicubic")
    likely = valid[0] & (frame.confidence > 0.5)
    return torch.where(likely, seen[0, 0] - images["mono"][0], 0.0).flatten()


def jacobian(values: Tensor, by: Tensor) -> Tensor:
    """d values (n) / d by (k, or one number), as (n, k): backwards twice, as fusion has no forward mode."""
    weights = torch.zeros_like(values, requires_grad=True)
    (slopes,) = torch.autograd.grad(values, by, weights, create_graph=True)
    columns = [torch.autograd.grad(slope, weights, retain_graph=True)[0] for slope in slopes.reshape(-1)]
    return torch.stack(columns, -1)


def recovered(
    network: FusionNetwork, rig: Rig, images: dict[str, Tensor], which: Sequence[str], *, steps: int
) -> list[Tensor]:
    """Return the remainder of a move by 1 in each of these ways, before and after each step."""
    left = [torch.ones(len(which), dtype=torch.float64)]
    for _ in range(steps):
        by = left[-1].clone().requires_grad_()
        rest = residuals(network, moved(rig, which, by), images)
        J = jacobian(rest, by)
        left.append(left[-1] - torch.linalg.lstsq(J, rest.detach()[:, None]).solution[:, 0])
    return left
