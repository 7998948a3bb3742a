"""A better rig from ordinary pictures: points matched between its cameras, what is known of it, and nothing else.

Chosen numbers z, in standard deviations of what they were known to (a calibration's, say), minimise

    sum_i log(1 + (r_i(z) / s)^2) + sum_k z_k^2

with r the Sampson distances of matched points (Hartley & Zisserman 11.4.3) and s the scale of the points' own noise:
Gauss-Newton steps on automatic derivatives through `arraygeom`, reweighted (Cauchy's loss). Numbers of which the
pictures say nothing new keep their values. Points held out decide whether the result is accepted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from arraygeom import Rig

from .matches import Matches, match_cameras
from .residuals import epipolar_residuals
from .unknowns import Unknown, changed, unknowns

Pairs = Mapping[tuple[str, str], Matches]
Frame = Mapping[str, Float[Tensor, "_ _ _"]]

FREE = ("rotation", "centre")
NO_NARROWER = 0.9
"""A number is left alone if the pictures leave more than this part of its standard deviation."""
HELD_OUT = 4
"""One part in so many of the points, or of the frames, is held out."""
CELL = 24
"""Points are held out by squares of so many pixels of alpha, so that none has a twin on the other side."""
SIGNIFICANT = 2.0
"""Held-out points must come nearer to their lines by so many standard errors."""
STEPS = 40
LEAST_NOISE = 0.03
"""Matched points are never taken to be better than this, pixels."""


@dataclass(frozen=True)
class Change:
    """Numbers that changed: by how much, and how well they are known now, in the unit people use."""

    name: str
    amount: tuple[float, ...]
    deviation: tuple[float, ...]
    unit: str

    def __str__(self) -> str:
        amounts = ", ".join(f"{a:+.3g} +- {d:.2g}" for a, d in zip(self.amount, self.deviation))
        return f"{self.name} {amounts} {self.unit}".rstrip()


class Agreement(NamedTuple):
    """How far points are from their lines: their number, the median and the root mean square of the nearest 85%."""

    count: int
    median: float
    rms: float

    def __str__(self) -> str:
        return f"{self.median:.2f} px"


@dataclass(frozen=True)
class Refined:
    """A rig made better, or not.

    rig: the better one if `accepted`, else the one given. changes: what is different in it. left_alone: numbers that
    the pictures do not determine. fitted, held_out: agreement before and after of the points that were used, and of
    those that were not. covariance: of all free numbers, in the order of `order`, in squared standard deviations of
    what was known before.
    """

    rig: Rig
    accepted: bool
    changes: tuple[Change, ...]
    left_alone: tuple[str, ...]
    fitted: tuple[Agreement, Agreement]
    held_out: tuple[Agreement, Agreement]
    order: tuple[Unknown, ...] = field(repr=False)
    covariance: Float[Tensor, "p p"] = field(repr=False)

    def as_text(self) -> str:
        """What changed and whether points that were held out agree, as people read it."""
        before, after = self.held_out
        lines = [f"held-out points ({before.count}) lie {before} off their lines before, {after} after"]
        if self.accepted:
            lines += [f"changed: {change}" for change in self.changes]
        else:
            lines.append("not accepted: held-out points come no nearer to their lines; the rig stays as it is")
        if self.left_alone:
            lines.append(f"left alone, not determined by these pictures: {', '.join(self.left_alone)}")
        return "\n".join(lines)


def refine(
    rig: Rig,
    frames: Sequence[Frame],
    *,
    free: Iterable[str] = FREE,
    sigma: Mapping[str, float] | None = None,
) -> Refined:
    """The rig after its free numbers are fitted to points matched in frames, each with a picture of every camera.

    The first camera that has pictures keeps its pose. `free` and `sigma` are as of `unknowns.unknowns`; F of links is
    always free. With two frames or more, whole frames are held out, else parts of the picture.
    Raises ValueError, one line: a camera that the rig lacks, a picture of another size than the rig says, equal
    pictures, too few points.
    """
    for frame in frames:
        _check(rig, frame)
    return refine_matches(rig, [match_cameras(frame) for frame in frames], free=free, sigma=sigma)


def refine_matches(
    rig: Rig,
    frames: Sequence[Pairs],
    *,
    free: Iterable[str] = FREE,
    sigma: Mapping[str, float] | None = None,
) -> Refined:
    """The same from points matched already."""
    used, kept = _split(frames)
    names = [name for name in rig.names if any(name in pair for pairs in (used, kept) for pair in pairs)]
    given = unknowns(rig, names, free=free, sigma=sigma)
    if not given:
        raise ValueError("nothing is free: the first camera keeps its pose; free more with --free, such as centre")
    solution = solve(lambda z: sampson(changed(rig, given, z), used), sum(len(u.sigma) for u in given))
    better = changed(rig, given, solution.z)
    off = [(_off(rig, pairs), _off(better, pairs)) for pairs in (used, kept)]
    fitted, held_out = ((agreement(before), agreement(after)) for before, after in off)
    accepted = bool(solution.active.any()) and nearer(*off[1])
    changes = tuple(_changes(given, solution)) if accepted else ()
    alone = tuple(_left_alone(given, solution.active))
    return Refined(
        better if accepted else rig, accepted, changes, alone, fitted, held_out, tuple(given), solution.covariance
    )


class Solution(NamedTuple):
    """The numbers z, which of them were free in the end, and the covariance of all, in units of the prior's."""

    z: Float[Tensor, " n"]
    active: Bool[Tensor, " n"]
    covariance: Float[Tensor, "n n"]


def solve(residuals: Callable[[Tensor], Tensor], count: int) -> Solution:
    """The most probable z under a normal prior of variance 1, leaving alone what the residuals do not tell.

    Numbers whose standard deviation stays above `NO_NARROWER` are set back to 0 and the rest is solved for anew.
    """
    active = torch.ones(count, dtype=torch.bool)
    while True:
        z = _most_probable(residuals, active)
        information, _ = _normal_equations(residuals, z, active)
        covariance = torch.linalg.inv(information)
        told = covariance.diagonal().sqrt() <= NO_NARROWER
        if bool((told == active).all()):
            return Solution(z, active, covariance)
        active = active & told


def _most_probable(residuals: Callable[[Tensor], Tensor], active: Tensor) -> Tensor:
    z = torch.zeros(len(active), dtype=torch.float64)
    for _ in range(STEPS):
        scale = _noise(residuals(z).detach())
        information, slope = _normal_equations(residuals, z, active)
        step = torch.linalg.solve(information, slope)
        z, moved = _shorten(residuals, z, step, scale)
        if moved < 1e-4:
            break
    return z


def _shorten(residuals: Callable[[Tensor], Tensor], z: Tensor, step: Tensor, scale: float) -> tuple[Tensor, float]:
    """A step along `step` that lowers the cost, halved until it does; and its largest entry."""
    before = _cost(residuals(z).detach(), z, scale)
    for _ in range(8):
        if _cost(residuals(z + step).detach(), z + step, scale) <= before:
            return z + step, float(step.abs().max())
        step = step / 2
    return z, 0.0


def _cost(r: Tensor, z: Tensor, scale: float) -> float:
    return float((r / scale).square().log1p().sum() + z.square().sum())


def _noise(r: Tensor) -> float:
    """The scale of the residuals: 1.48 times their median size, which is the deviation of normal ones."""
    return max(1.4826 * float(r.abs().median()), LEAST_NOISE)


def _normal_equations(residuals: Callable[[Tensor], Tensor], z: Tensor, active: Tensor) -> tuple[Tensor, Tensor]:
    """J^T W J + I and -(J^T W r + z), reweighted for Cauchy's loss; inactive numbers have a prior alone and stay."""
    r, J = jacobian(residuals, z)
    J = torch.where(active, J, 0.0)
    scale = _noise(r)
    weight = 1 / (scale**2 + r.square())
    eye = torch.eye(len(z), dtype=z.dtype)
    return J.T @ (weight[:, None] * J) + eye, -(J.T @ (weight * r) + torch.where(active, z, 0.0))


def jacobian(f: Callable[[Tensor], Tensor], z: Float[Tensor, " n"]) -> tuple[Float[Tensor, " m"], Float[Tensor, "m n"]]:
    """f(z) and its derivatives, of many values in few numbers.

    The gradient of u . f in z is linear in u; its derivatives in u are the columns wanted: n + 1 backward passes.
    """
    z = z.detach().requires_grad_()
    values = f(z)
    u = torch.zeros_like(values, requires_grad=True)
    (slope,) = torch.autograd.grad(values, z, u, create_graph=True)
    columns = [torch.autograd.grad(s, u, retain_graph=True)[0] for s in slope]
    return values.detach(), torch.stack(columns, -1)


def sampson(rig: Rig, pairs: Pairs) -> Float[Tensor, " n"]:
    """Sampson distances of all points of all pairs, pixels; 0 where a pixel has no ray."""
    parts = [epipolar_residuals(rig.pair(*names), matches) for names, matches in pairs.items()]
    return torch.cat([torch.where(part.valid, part.sampson, 0.0) for part in parts])


def agreement(off: Float[Tensor, " n"]) -> Agreement:
    """How far points are from their lines, in short."""
    nearest = off.abs().sort().values[: max(1, int(0.85 * len(off)))]
    return Agreement(len(off), float(off.abs().median()), float(nearest.square().mean().sqrt()))


def nearer(before: Float[Tensor, " n"], after: Float[Tensor, " n"]) -> bool:
    """Whether points came nearer to their lines by more than chance: a paired test, each distance cut at 5 px."""
    gain = before.abs().clamp(max=5) - after.abs().clamp(max=5)
    return float(gain.mean()) > SIGNIFICANT * float(gain.std()) / len(gain) ** 0.5


def _off(rig: Rig, pairs: Pairs) -> Tensor:
    """Distances in pixels of points from their lines, in beta."""
    return torch.cat([epipolar_residuals(rig.pair(*n), m).line.detach() for n, m in pairs.items()])


def _split(frames: Sequence[Pairs]) -> tuple[dict[tuple[str, str], Matches], dict[tuple[str, str], Matches]]:
    """Points to use and points to hold out: whole frames if there are several, else squares of alpha's picture."""
    if len(frames) > 1:
        held_out = max(1, len(frames) // HELD_OUT)
        return _joined(frames[:-held_out]), _joined(frames[-held_out:])
    (pairs,) = frames
    marks = {names: _marks(matches) for names, matches in pairs.items()}
    return (
        {names: matches.only(~marks[names]) for names, matches in pairs.items()},
        {names: matches.only(marks[names]) for names, matches in pairs.items() if bool(marks[names].any())},
    )


def _marks(matches: Matches) -> Tensor:
    """Points in one square out of `HELD_OUT`."""
    column, row = (matches.alpha / CELL).floor().long().unbind(-1)
    return (column + 2 * row) % HELD_OUT == 0


def _joined(frames: Sequence[Pairs]) -> dict[tuple[str, str], Matches]:
    names = dict.fromkeys(name for frame in frames for name in frame)
    parts = {name: [frame[name] for frame in frames if name in frame] for name in names}
    return {name: Matches(*(torch.cat(side) for side in zip(*found))) for name, found in parts.items()}


def _check(rig: Rig, frame: Frame) -> None:
    for name, picture in frame.items():
        h, w = rig[name].hw
        if tuple(picture.shape[1:]) != (h, w):
            got = f"{picture.shape[2]}x{picture.shape[1]}"
            raise ValueError(
                f"the picture of '{name}' is {got}, the rig says {w}x{h}: `pat rig doctor` tells what was done to it"
            )


def _changes(given: Sequence[Unknown], solution: Solution) -> Iterable[Change]:
    sizes = [len(u.sigma) for u in given]
    deviations = solution.covariance.diagonal().sqrt().split(sizes)
    for u, z, deviation, active in zip(given, solution.z.split(sizes), deviations, solution.active.split(sizes)):
        if bool(active.any()):
            scale = u.sigma * u.factor
            yield Change(u.name, tuple((z * scale).tolist()), tuple((deviation * scale).tolist()), u.unit)


def _left_alone(given: Sequence[Unknown], active: Tensor) -> Iterable[str]:
    for u, mine in zip(given, active.split([len(u.sigma) for u in given])):
        if not bool(mine.any()):
            yield u.name
        else:
            yield from (u.spoken(i) for i, free in enumerate(mine.tolist()) if not free)
