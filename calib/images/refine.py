"""A better rig from ordinary images: points matched between its cameras, what is known of it, and nothing else.

Chosen numbers z, in standard deviations of what they were known to (a calibration's, say), minimise

    sum_i log(1 + (r_i(z) / s)^2) + sum_k z_k^2

with r the Sampson distances of matched points (Hartley & Zisserman 11.4.3) and s the scale of the points' own noise:
Gauss-Newton steps on automatic derivatives through `arraygeom`, reweighted (Cauchy's loss). Numbers of which the
images say nothing new keep their values. Points held out decide whether the result is accepted. What the points
told is then the prior of a second fit, to the photometric error of the fusion itself: see `photometric`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from arraygeom import Camera, Rig

from .lenses import spoken_lenses, with_lenses
from .matches import ENOUGH, Matches, match_cameras, with_map
from .parameters import Unknown, changed, unknowns
from .photometric import Attend, Views, photometric_errors, with_depths
from .residuals import epipolar_residuals, related

Pairs = Mapping[tuple[str, str], Matches]
Frame = Mapping[str, Float[Tensor, "_ _ _"]]

FREE = ("rotation", "centre")
MORE = ("translation",)
"""Freed too where points demand it: along their lines images tell little of it, and depths would drift."""
NO_NARROWER = 0.9
"""A number is left alone if the images leave more than this part of its standard deviation."""
HELD_OUT = 4
"""One part in so many of the points, or of the frames, is held out."""
CELL = 24
"""Points are held out by squares of so many pixels of alpha, so that none has a twin on the other side."""
SIGNIFICANT = 2.0
"""Held-out points must come nearer to their lines by so many standard errors."""
STEPS = 40
TOGETHER = 10.0
"""So many neighbouring errors of the fusion count as one."""
ROUNDS = 8
"""Steps of the search for the least photometric error."""
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
        if self.unit == "F":
            return f"F of {self.name}"
        amounts = ", ".join(f"{a:+.3g} +- {d:.2g}" for a, d in zip(self.amount, self.deviation))
        return f"{self.name} {amounts} {self.unit}".rstrip()


class Agreement(NamedTuple):
    """How far points are from their lines: their number, the median and the root mean square of the nearest 85%."""

    points: int
    median: float
    rms: float

    def __str__(self) -> str:
        return f"{self.median:.2f} px"


class Photometric(NamedTuple):
    """The fusion's photometric error on held-out pixels, before and after its own stage, and whether that was kept."""

    before: float
    after: float
    accepted: bool


@dataclass(frozen=True)
class Refined:
    """A rig made better, or not.

    rig: the better one if `accepted`, else the one given. changes: what is different in it. left_alone: numbers that
    the images do not determine. fitted, held_out: agreement before and after of the points that were used, and of
    those that were not. photometric: what the fusion's own error did, if it was asked.
    """

    rig: Rig
    accepted: bool
    changes: tuple[Change, ...]
    left_alone: tuple[str, ...]
    fitted: tuple[Agreement, Agreement]
    held_out: tuple[Agreement, Agreement]
    photometric: Photometric | None = None

    def as_text(self) -> str:
        """What changed and whether points that were held out agree, as people read it."""
        before, after = self.held_out
        lines = [f"held-out points ({before.points}) lie {before} off their lines before, {after} after"]
        if self.accepted:
            lines += [f"changed: {change}" for change in self.changes]
            lines += [sentence] if (sentence := spoken_lenses(self.rig)) else []
        else:
            lines.append("not accepted: held-out points come no nearer to their lines; the rig stays as it is")
        if self.left_alone:
            lines.append(f"left alone, not determined by these images: {', '.join(self.left_alone)}")
        if self.photometric is not None:
            b, a, kept = self.photometric
            verdict = "kept" if kept else "not kept"
            lines.append(f"the fusion's own error on held-out pixels: {b:.4f} before, {a:.4f} after: {verdict}")
        return "\n".join(lines)


def refine(
    rig: Rig,
    frames: Sequence[Frame],
    *,
    free: Iterable[str] = FREE,
    sigma: Mapping[str, float] | None = None,
    attend: Attend | None = None,
) -> Refined:
    """The rig after its free numbers are fitted to points matched in frames, each with an image of every camera.

    The first camera that has images keeps its pose. `free` and `sigma` are as of `unknowns.unknowns`; F of links is
    always free, and views that are known by F alone are given lenses where points that were held out come nearer to
    their lines so. With two frames or more, whole frames are held out, else parts of the image. With `attend`,
    the fusion's own error then has its say, with what the points told as its prior.
    Raises ValueError, one line: a camera that the rig lacks, an image of another size than the rig says, equal
    images, too few points.
    """
    for frame in frames:
        _check(rig, frame)
    fit, solution = fitted(rig, [match_cameras(frame) for frame in frames], free=free, sigma=sigma)
    told = fit.report(solution)
    if attend is None or not told.accepted:
        return told
    polished, errors = polish(fit, solution, frames, attend)
    return replace(fit.report(polished) if errors.accepted else told, photometric=errors)


def refine_matches(
    rig: Rig,
    frames: Sequence[Pairs],
    *,
    free: Iterable[str] = FREE,
    sigma: Mapping[str, float] | None = None,
) -> Refined:
    """The same from points matched already, without the fusion's error."""
    fit, solution = fitted(rig, frames, free=free, sigma=sigma)
    return fit.report(solution)


def fitted(
    rig: Rig, frames: Sequence[Pairs], *, free: Iterable[str], sigma: Mapping[str, float] | None
) -> tuple[Fit, Solution]:
    """The fit and what it tells; of more numbers where points that were held out come nearer to their lines so.

    More are translations, if `free` is the default, and lenses of views that are known by F.
    """
    free = tuple(free)
    found = _fitted(rig, frames, free, sigma)
    if free == FREE and any(isinstance(view, Camera) for view in rig.cameras.values()):
        found = _nearer(found, _fitted(rig, frames, (*FREE, *MORE), sigma))
    has_lens = with_lenses(rig, rig.names)
    return found if has_lens is rig else _nearer(found, _fitted(has_lens, frames, free, sigma))


def _fitted(
    rig: Rig, frames: Sequence[Pairs], free: tuple[str, ...], sigma: Mapping[str, float] | None
) -> tuple[Fit, Solution]:
    fit = Fit.of(rig, frames, free=free, sigma=sigma)
    return fit, fit.solve()


def _nearer(found: tuple[Fit, Solution], other: tuple[Fit, Solution]) -> tuple[Fit, Solution]:
    """The other fit if held-out points come nearer to their lines by it."""
    off = [line_distances(fit.after(solution.z), fit.held_out) for fit, solution in (found, other)]
    return other if nearer(*off) else found


@dataclass(frozen=True)
class Fit:
    """A rig, what may change in it, and the points: those used and those held out."""

    rig: Rig
    given: tuple[Unknown, ...]
    used: Pairs
    held_out: Pairs

    @classmethod
    def of(cls, rig: Rig, frames: Sequence[Pairs], *, free: Iterable[str], sigma: Mapping[str, float] | None) -> Fit:
        """Raises ValueError if nothing is free."""
        used, held_out = split([related(rig, pairs) for pairs in frames])
        names = [name for name in rig.names if any(name in pair for pairs in (used, held_out) for pair in pairs)]
        given = unknowns(rig, names, free=free, sigma=sigma)
        if not given:
            raise ValueError("nothing is free: the first camera keeps its pose; free more with --free, such as centre")
        return cls(rig, tuple(given), used, held_out)

    def after(self, z: Float[Tensor, " n"]) -> Rig:
        """The rig after a change of z, in standard deviations."""
        return changed(self.rig, self.given, z)

    def prior(self) -> Solution:
        """What is known before any point: no change, give or take a standard deviation."""
        count = sum(len(u.sigma) for u in self.given)
        eye = torch.eye(count, dtype=torch.float64)
        return Solution(torch.zeros(count, dtype=torch.float64), torch.ones(count, dtype=torch.bool), eye)

    def solve(self) -> Solution:
        """What the used points tell."""
        return solve(lambda z: sampson(self.after(z), self.used), sum(len(u.sigma) for u in self.given))

    def report(self, solution: Solution) -> Refined:
        """What a solution changes, and whether the held-out points accept it."""
        better = self.after(solution.z)
        off = [(line_distances(self.rig, pairs), line_distances(better, pairs)) for pairs in (self.used, self.held_out)]
        fitted, held_out = ((agreement(before), agreement(after)) for before, after in off)
        accepted = bool(solution.active.any()) and nearer(*off[1])
        changes = tuple(_changes(self.given, solution)) if accepted else ()
        alone = tuple(_left_alone(self.given, solution.active))
        rig = _with_maps(better, self.used) if accepted else self.rig
        return Refined(rig, accepted, changes, alone, fitted, held_out)


def polish(fit: Fit, solution: Solution, frames: Sequence[Frame], attend: Attend) -> tuple[Solution, Photometric]:
    """The solution moved to where the fusion's photometric error is least, with what the points told as its prior.

    Errors are compared with their own deviation and count as one measurement for every `TOGETHER` pixels, because
    neighbours err alike. Kept if the error falls on held-out pixels too and held-out points do not mind.
    """
    rig = with_depths(fit.after(solution.z), fit.used)
    base = replace(fit, rig=fit.rig.replace(depth=rig.depth))
    views = [Views.of(frame) for frame in frames]
    root = torch.linalg.cholesky(solution.covariance)[:, solution.active]

    def errors(z: Tensor, *, held_out: bool) -> Tensor:
        parts = [photometric_errors(base.after(z), v, names, attend) for v in views for names in fit.used]
        return torch.cat([error[seen & (_marked(error) == held_out)] for error, seen in parts])

    noise = _noise(errors(solution.z, held_out=False).detach())
    y = torch.zeros(root.shape[1], dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([y], max_iter=ROUNDS, line_search_fn="strong_wolfe", tolerance_change=1e-4)

    def cost() -> Tensor:
        optimiser.zero_grad()
        left = errors(solution.z + root @ y, held_out=False) / noise
        total = left.square().log1p().sum() / TOGETHER + y.square().sum()
        total.backward()
        return total

    optimiser.step(cost)
    z = (solution.z + root @ y).detach()
    before, after = (float(errors(v, held_out=True).detach().abs().mean()) for v in (solution.z, z))
    off = [line_distances(fit.after(v), fit.held_out) for v in (z, solution.z)]
    return solution._replace(z=z), Photometric(before, after, after < before and not nearer(*off))


def _marked(error: Tensor) -> Tensor:
    """Held-out pixels of a grid: one square of 4 x 4 in `HELD_OUT`."""
    rows, columns = (torch.arange(n) // 4 for n in error.shape)
    return (columns + 2 * rows[:, None]) % HELD_OUT == 0


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

    The gradient of u . f in z is linear in u; its derivatives in u are the columns wanted, all at once.
    """
    z = z.detach().requires_grad_()
    values = f(z)
    u = torch.zeros_like(values, requires_grad=True)
    (slope,) = torch.autograd.grad(values, z, u, create_graph=True)
    (columns,) = torch.autograd.grad(slope, u, torch.eye(len(z)).to(slope), is_grads_batched=True)
    return values.detach(), columns.T


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


def line_distances(rig: Rig, pairs: Pairs) -> Float[Tensor, " n"]:
    """Signed distances in pixels of all points from their lines, in beta."""
    return torch.cat([epipolar_residuals(rig.pair(*n), m).line.detach() for n, m in pairs.items()])


def split(frames: Sequence[Pairs]) -> tuple[dict[tuple[str, str], Matches], dict[tuple[str, str], Matches]]:
    """Points to use and points to hold out: whole frames if there are several, else squares of alpha's image."""
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


def _with_maps(rig: Rig, pairs: Pairs) -> Rig:
    """The rig whose links have a rough map where they had none and points tell one."""
    links = dict(rig.links)
    for names, matches in pairs.items():
        if names in links and links[names].H is None and len(matches.alpha) >= ENOUGH:
            links[names] = with_map(rig.pair(*names), matches).link
    return rig.replace(links=links)


def _check(rig: Rig, frame: Frame) -> None:
    for name, image in frame.items():
        h, w = rig[name].hw
        if tuple(image.shape[1:]) != (h, w):
            got = f"{image.shape[2]}x{image.shape[1]}"
            raise ValueError(
                f"the image of '{name}' is {got}, the rig says {w}x{h}: `pat rig doctor` tells what was done to it"
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
