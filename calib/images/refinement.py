"""Refinement of a rig by points matched between ordinary images, and a prior of its parameters.

The free parameters z, in units of their prior standard deviations (of a calibration, say), minimise

    sum_i log(1 + (r_i(z) / s)^2) + sum_k z_k^2

with r the Sampson distances of matched points (Hartley & Zisserman 11.4.3) and s the scale of the points' noise:
Gauss-Newton steps on automatic derivatives through `arraygeom`, reweighted (Cauchy's loss). Parameters that the images
do not determine keep their values. Held-out points decide whether the result is accepted. Its posterior is then the
prior of a second fit, to the photometric error of the fusion: see `photometric`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from arraygeom import Camera, Rig

from .lenses import describe_lenses, with_lenses
from .matches import ENOUGH, Matches, match_cameras, with_map
from .parameters import FreeParameter, apply_change, free_parameters
from .photometric import Attend, PhotometricFrame, photometric_errors, with_depths
from .residuals import epipolar_residuals, related

Pairs = Mapping[tuple[str, str], Matches]
Frame = Mapping[str, Float[Tensor, "_ _ _"]]

FREE = ("rotation", "centre")
EXTRA_FREE = ("translation",)
"""Freed too if held-out points improve: otherwise it is poorly constrained, and depths would drift."""
LARGEST_POSTERIOR = 0.9
"""A parameter is fixed if its posterior standard deviation stays above this share of the prior's."""
HELD_OUT = 4
"""One in this many points or frames is held out."""
CELL = 24
"""Points are held out by squares of this many pixels of alpha, so that neighbours are in the same part."""
SIGNIFICANT = 2.0
"""Standard errors by which the distances of held-out points must decrease."""
STEPS = 40
CORRELATED_PIXELS = 10.0
"""Photometric errors of this many neighbouring pixels count as one measurement."""
ROUNDS = 8
"""Iterations of the photometric minimisation."""
LEAST_NOISE = 0.03
"""Lower bound of the noise of matched points, pixels."""


@dataclass(frozen=True)
class ParameterChange:
    """The change of a parameter vector and its posterior standard deviation, in the unit for display."""

    name: str
    amount: tuple[float, ...]
    deviation: tuple[float, ...]
    unit: str

    def __str__(self) -> str:
        if self.unit == "F":
            return f"F of {self.name}"
        amounts = ", ".join(f"{a:+.3g} +- {d:.2g}" for a, d in zip(self.amount, self.deviation))
        return f"{self.name} {amounts} {self.unit}".rstrip()


class LineStatistics(NamedTuple):
    """Distances of points from their lines, pixels: number, median, and root mean square of the nearest 85%."""

    points: int
    median: float
    rms: float

    def __str__(self) -> str:
        return f"{self.median:.2f} px"


class PhotometricResult(NamedTuple):
    """The photometric error on held-out pixels before and after its minimisation, and whether that was accepted."""

    before: float
    after: float
    accepted: bool


@dataclass(frozen=True)
class Refinement:
    """The result of a refinement.

    rig: the refined one if `accepted`, else the given one. changes: its differences. unobservable: parameters that the
    images do not determine. fitted, held_out: statistics before and after of the points used, and of those held out.
    photometric: the photometric error, if it was minimised.
    """

    rig: Rig
    accepted: bool
    changes: tuple[ParameterChange, ...]
    unobservable: tuple[str, ...]
    fitted: tuple[LineStatistics, LineStatistics]
    held_out: tuple[LineStatistics, LineStatistics]
    photometric: PhotometricResult | None = None

    def as_text(self) -> str:
        """The changes and the distances of held-out points, as text."""
        given, refined = self.held_out
        lines = [f"held-out points ({given.points}) lie {given} from their lines before, {refined} after"]
        if self.accepted:
            lines += [f"changed: {change}" for change in self.changes]
            lines += [sentence] if (sentence := describe_lenses(self.rig)) else []
        else:
            lines.append("not accepted: held-out points are no nearer to their lines; the rig is unchanged")
        if self.unobservable:
            lines.append(f"fixed, as these images do not determine them: {', '.join(self.unobservable)}")
        if self.photometric is not None:
            before, after, accepted = self.photometric
            verdict = "accepted" if accepted else "not accepted"
            lines.append(f"photometric error on held-out pixels: {before:.4f} before, {after:.4f} after: {verdict}")
        return "\n".join(lines)


def refine(
    rig: Rig,
    frames: Sequence[Frame],
    *,
    free: Iterable[str] = FREE,
    sigma: Mapping[str, float] | None = None,
    attend: Attend | None = None,
) -> Refinement:
    """Refine a rig by points matched in frames, each with an image of every camera.

    The first camera that has images keeps its pose. `free` and `sigma` are those of `parameters.free_parameters`; F of
    links is always free, and views known by F alone are given lenses if held-out points improve. With two frames or
    more, whole frames are held out, else parts of the image. With `attend` the photometric error of the fusion is then
    minimised, with the posterior of the points as its prior. Raises ValueError, one line: a camera that the rig lacks,
    an image of another size than the rig states, equal images, too few points.
    """
    for frame in frames:
        _check(rig, frame)
    fit, solution = fitted(rig, [match_cameras(frame) for frame in frames], free=free, sigma=sigma)
    refined = fit.report(solution)
    if attend is None or not refined.accepted:
        return refined
    polished, errors = polish(fit, solution, frames, attend)
    return replace(fit.report(polished) if errors.accepted else refined, photometric=errors)


def refine_matches(
    rig: Rig, frames: Sequence[Pairs], *, free: Iterable[str] = FREE, sigma: Mapping[str, float] | None = None
) -> Refinement:
    """`refine` from matched points, without the photometric error."""
    fit, solution = fitted(rig, frames, free=free, sigma=sigma)
    return fit.report(solution)


def fitted(
    rig: Rig, frames: Sequence[Pairs], *, free: Iterable[str], sigma: Mapping[str, float] | None
) -> tuple[RefinementProblem, Solution]:
    """The fit and its solution, with additional free parameters if held-out points improve.

    Those are translations, if `free` is the default, and lenses of views known by F.
    """
    free = tuple(free)
    candidates = [(rig, free)]
    if free == FREE and any(isinstance(view, Camera) for view in rig.cameras.values()):
        candidates.append((rig, (*FREE, *EXTRA_FREE)))
    if (with_lens := with_lenses(rig, rig.names)) is not rig:
        candidates.append((with_lens, free))
    fits = [RefinementProblem.of(*candidate, frames=frames, sigma=sigma) for candidate in candidates]
    best, *others = [(fit, fit.solve()) for fit in fits]
    for other in others:
        distances = [line_distances(fit.after(solution.z), fit.held_out) for fit, solution in (best, other)]
        best = other if nearer(*distances) else best
    return best


@dataclass(frozen=True)
class RefinementProblem:
    """A rig, its free parameters, and the points used and held out."""

    rig: Rig
    parameters: tuple[FreeParameter, ...]
    used: Pairs
    held_out: Pairs

    @classmethod
    def of(
        cls, rig: Rig, free: Iterable[str], *, frames: Sequence[Pairs], sigma: Mapping[str, float] | None = None
    ) -> RefinementProblem:
        """Raises ValueError if nothing is free."""
        used, held_out = split([related(rig, pairs) for pairs in frames])
        names = [name for name in rig.names if any(name in pair for pairs in (used, held_out) for pair in pairs)]
        parameters = free_parameters(rig, names, free=free, sigma=sigma)
        if not parameters:
            raise ValueError("nothing is free: the first camera keeps its pose; free more with --free, such as centre")
        return cls(rig, tuple(parameters), used, held_out)

    def after(self, z: Float[Tensor, " n"]) -> Rig:
        """The rig after a change of z, in standard deviations."""
        return apply_change(self.rig, self.parameters, z)

    def solve(self) -> Solution:
        """The posterior given the used points."""
        return solve(lambda z: sampson(self.after(z), self.used), sum(len(u.sigma) for u in self.parameters))

    def report(self, solution: Solution) -> Refinement:
        """The changes by a solution, and whether the held-out points support it."""
        refined = self.after(solution.z)
        distances = [
            (line_distances(self.rig, pairs), line_distances(refined, pairs)) for pairs in (self.used, self.held_out)
        ]
        fitted, held_out = ((line_statistics(before), line_statistics(after)) for before, after in distances)
        accepted = bool(solution.active.any()) and nearer(*distances[1])
        changes = tuple(_changes(self.parameters, solution)) if accepted else ()
        unobservable = tuple(_unobservable(self.parameters, solution.active))
        rig = _with_maps(refined, self.used) if accepted else self.rig
        return Refinement(rig, accepted, changes, unobservable, fitted, held_out)


def polish(
    fit: RefinementProblem, solution: Solution, frames: Sequence[Frame], attend: Attend
) -> tuple[Solution, PhotometricResult]:
    """Minimise the photometric error of the fusion, with the solution of the points as its prior.

    Errors are scaled by their own deviation and count as one measurement per `CORRELATED_PIXELS` pixels, as neighbours
    are correlated. Accepted if the error on held-out pixels falls and held-out points are not significantly worse.
    """
    rig = with_depths(fit.after(solution.z), fit.used)
    base = replace(fit, rig=fit.rig.replace(depth=rig.depth))
    views = [PhotometricFrame.of(frame) for frame in frames]
    root = torch.linalg.cholesky(solution.covariance)[:, solution.active]

    def errors(z: Tensor, *, held_out: bool) -> Tensor:
        parts = [photometric_errors(base.after(z), v, names, attend) for v in views for names in fit.used]
        return torch.cat([error[valid & (_held_out_pixels(error) == held_out)] for error, valid in parts])

    noise = _noise(errors(solution.z, held_out=False).detach())
    y = torch.zeros(root.shape[1], dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([y], max_iter=ROUNDS, line_search_fn="strong_wolfe", tolerance_change=1e-4)

    def cost() -> Tensor:
        optimiser.zero_grad()
        left = errors(solution.z + root @ y, held_out=False) / noise
        total = left.square().log1p().sum() / CORRELATED_PIXELS + y.square().sum()
        total.backward()
        return total

    optimiser.step(cost)
    z = (solution.z + root @ y).detach()
    before, after = (float(errors(v, held_out=True).detach().abs().mean()) for v in (solution.z, z))
    off = [line_distances(fit.after(v), fit.held_out) for v in (z, solution.z)]
    return solution._replace(z=z), PhotometricResult(before, after, after < before and not nearer(*off))


def _held_out_pixels(error: Tensor) -> Tensor:
    """Held-out pixels of a grid: one square of 4 x 4 in `HELD_OUT`."""
    rows, columns = (torch.arange(n) // 4 for n in error.shape)
    return (columns + 2 * rows[:, None]) % HELD_OUT == 0


class Solution(NamedTuple):
    """The parameters z, which of them were observable, and their covariance, in units of the prior's deviations."""

    z: Float[Tensor, " n"]
    active: Bool[Tensor, " n"]
    covariance: Float[Tensor, "n n"]


def solve(residuals: Callable[[Tensor], Tensor], count: int) -> Solution:
    """The most probable z under a normal prior of variance 1, with unobservable parameters fixed.

    Parameters whose standard deviation stays above `LARGEST_POSTERIOR` are reset to 0 and the others solved for again.
    """
    active = torch.ones(count, dtype=torch.bool)
    while True:
        z = _most_probable(residuals, active)
        information, _ = _normal_equations(residuals, z, active)
        covariance = torch.linalg.inv(information)
        observable = covariance.diagonal().sqrt() <= LARGEST_POSTERIOR
        if bool((observable == active).all()):
            return Solution(z, active, covariance)
        active = active & observable


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
    """J^T W J + I and -(J^T W r + z), reweighted for Cauchy's loss; inactive parameters have only their prior."""
    r, J = jacobian(residuals, z)
    J = torch.where(active, J, 0.0)
    scale = _noise(r)
    weight = 1 / (scale**2 + r.square())
    eye = torch.eye(len(z), dtype=z.dtype)
    return J.T @ (weight[:, None] * J) + eye, -(J.T @ (weight * r) + torch.where(active, z, 0.0))


def jacobian(f: Callable[[Tensor], Tensor], z: Float[Tensor, " n"]) -> tuple[Float[Tensor, " m"], Float[Tensor, "m n"]]:
    """f(z) and its derivatives, for many values of few parameters.

    The gradient of u . f in z is linear in u; its derivatives in u are the columns of the Jacobian.
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


def line_statistics(distance: Float[Tensor, " n"]) -> LineStatistics:
    """Statistics of the distances of points from their lines."""
    nearest = distance.abs().sort().values[: max(1, int(0.85 * len(distance)))]
    return LineStatistics(len(distance), float(distance.abs().median()), float(nearest.square().mean().sqrt()))


def nearer(before: Float[Tensor, " n"], after: Float[Tensor, " n"]) -> bool:
    """Whether distances from the lines decreased significantly: a paired test, distances clipped at 5 px."""
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
    marks = {names: _held_out_points(matches) for names, matches in pairs.items()}
    return (
        {names: matches.only(~marks[names]) for names, matches in pairs.items()},
        {names: matches.only(marks[names]) for names, matches in pairs.items() if bool(marks[names].any())},
    )


def _held_out_points(matches: Matches) -> Tensor:
    """Points in one square out of `HELD_OUT`."""
    column, row = (matches.alpha / CELL).floor().long().unbind(-1)
    return (column + 2 * row) % HELD_OUT == 0


def _joined(frames: Sequence[Pairs]) -> dict[tuple[str, str], Matches]:
    names = dict.fromkeys(name for frame in frames for name in frame)
    parts = {name: [frame[name] for frame in frames if name in frame] for name in names}
    return {name: Matches(*(torch.cat(side) for side in zip(*found))) for name, found in parts.items()}


def _with_maps(rig: Rig, pairs: Pairs) -> Rig:
    """The rig with a rough map for links that have none, by their points."""
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
                f"the image of '{name}' is {got}, the rig states {w}x{h}: `pat rig doctor` finds the reason"
            )


def _changes(parameters: Sequence[FreeParameter], solution: Solution) -> Iterable[ParameterChange]:
    sizes = [len(u.sigma) for u in parameters]
    deviations = solution.covariance.diagonal().sqrt().split(sizes)
    for u, z, deviation, active in zip(parameters, solution.z.split(sizes), deviations, solution.active.split(sizes)):
        if bool(active.any()):
            scale = u.sigma * u.factor
            yield ParameterChange(u.name, tuple((z * scale).tolist()), tuple((deviation * scale).tolist()), u.unit)


def _unobservable(parameters: Sequence[FreeParameter], active: Tensor) -> Iterable[str]:
    for u, mine in zip(parameters, active.split([len(u.sigma) for u in parameters])):
        if not bool(mine.any()):
            yield u.name
        else:
            yield from (u.label(i) for i, free in enumerate(mine.tolist()) if not free)
