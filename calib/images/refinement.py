"""Refinement of a rig by points matched between ordinary images, and a prior of its parameters.

The free parameters z, in units of their prior standard deviations (of a calibration, say), minimise

    sum_i log(1 + (r_i(z) / s)^2) + sum_k z_k^2

with r the Sampson distances of matched points (Hartley & Zisserman 11.4.3) and s the scale of the points'
noise: Gauss-Newton steps on automatic derivatives through `arraygeom`, reweighted (Cauchy's loss). The rest
(other parameters of the cameras, and what their lens models leave) is uncertain all the same and takes its
share of the residuals. Parameters that the images do not determine keep their values, and so do combinations
of them that would change depth without the images determining it (`depth_change`). Held-out points, the prior
and the uncertainty of depth decide whether the result is accepted. Its posterior is then the prior of a
second fit, to the photometric error of the fusion: see `photometric`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, count, product

import torch
from jaxtyping import Bool, Float
from scipy.linalg import qr
from torch import Tensor

from arraygeom import Camera, Rig
from arraygeom.runtime.progress import log_step, part, stage
from arraygeom.runtime.threads import torch_in_one_thread

from .depth_change import NEGLIGIBLE, DepthChange, depth_modes, log_depths, relative_change, share_outside
from .least_squares import (
    Evaluated,
    Residuals,
    Solution,
    jacobian,
    most_probable,
    noise_scale,
    shifts_left_out,
    solve,
)
from .lenses import with_distortion, with_lenses
from .matches import (
    ENOUGH,
    MATCHING_SHARE,
    Images,
    Pairs,
    agreeing_pairs,
    cameras_of,
    depth_seen,
    image_sizes,
    match_cameras,
    with_map,
)
from .parameters import LARGEST_CHANGE, FreeParameter, apply_change, considered_parameters, free_parameters
from .photometric import Attend, PhotometricImage, photometric_errors
from .refined import LineStatistics, ParameterChange, PhotometricResult, Refinement
from .residuals import (
    held_out_pixels,
    image_parts,
    line_distances,
    median_off,
    nearer,
    own_distance,
    related,
    sampson_of_pairs,
    split,
    systematic_modes,
)

LOG = logging.getLogger(__name__)

FREE = ("rotation", "centre")
EXTRA_FREE = ("focal", "translation")
"""Kinds of parameters that are freed too if held-out points improve."""
SYSTEMATIC = 0.3
"""Prior deviation, pixels at the image's corner, of each smooth displacement that a lens model leaves."""
LARGEST_DISTANCE, OF_OWN = 1.0, 3.0
"""Largest median distance of held-out points from their lines, in pixels, and as a multiple of their distance
from the lines of an F fitted to them; a refined rig beyond both is refused."""
AT_BEST = 1.1
"""Factor of held-out points' distance from the lines of an F fitted to them within which no more is freed."""
MOST_BEHIND = 0.5
"""Largest share of points behind a camera: some wrong matches always are."""
UNCHANGED = 1e-3
"""Relative deviation of depth within which a pattern of depth keeps its value."""
CORRELATED_PIXELS = 10.0
"""Number of neighbouring pixels whose photometric errors count as one measurement."""
ROUNDS, EVALUATIONS = 8, 13
"""Iterations of the photometric minimisation, and its rough number of evaluations of the error of
all pairs."""
LEFT_OUT_SIGMA = 1.0
"""Prior deviation of lens terms that may have been left out, as a share of typical ones."""


@torch_in_one_thread()
def refine(
    rig: Rig,
    frames: Sequence[Images],
    *,
    free: Iterable[str] = FREE,
    sigma: Mapping[str, float] | None = None,
    attend: Attend | None = None,
    force: bool = False,
    matches: Sequence[Pairs] | None = None,
) -> Refinement:
    """Refine a rig by points matched in frames, each with images of two or more of its cameras.

    The first camera that has images keeps its pose. F of links is always free, and views known by F alone are
    given lenses if held-out points improve. With two frames or more, whole frames are held out, else parts of
    the image.

    Args:
        frames: one image (C, H, W) in 0..1 per camera, by name, of the rig's sizes.
        free: free parameters: kinds such as "rotation" or "focal", or patterns over "camera.kind".
        sigma: prior standard deviations by kind, in the rig's units; None for the usual ones (`SIGMA`).
        attend: attention by which the photometric error of the fusion is then minimised, with the posterior
            of the points as its prior; None leaves that stage out.
        force: True to accept a result in spite of objections.
        matches: points of each frame used instead of matching its images; None to match them.

    Returns:
        The refined rig if accepted, else the given one, with changes and objections.

    Raises:
        ValueError: in one line, for no frame, a camera that the rig lacks, an image of another size than the
            rig states, equal images, too few points, or nothing free.
    """
    if not frames:
        raise ValueError("no frame: give images of two cameras or more")
    for name, (height, width) in (item for frame in frames for item in image_sizes(frame).items()):
        h, w = rig[name].hw
        if (height, width) != (h, w):
            raise ValueError(
                f"the image of '{name}' is {width}x{height}, the rig states {w}x{h}: "
                "`pat rig doctor` finds the reason"
            )
    with stage("points" + ", stage 1 of 2" * (attend is not None), new=True):
        pairs = []
        for i, frame in enumerate(frames):
            with part(MATCHING_SHARE * i / len(frames), MATCHING_SHARE * (i + 1) / len(frames)):
                pairs.append(match_cameras(frame) if matches is None else agreeing_pairs(matches[i]))
        with part(MATCHING_SHARE, 1):
            fit, solution = fitted(rig, pairs, free=free, sigma=sigma)
    refined = fit.report(solution, force=force)
    if attend is None or not refined.accepted or not solution.directions.shape[1]:
        return refined
    with stage("the fusion's error, stage 2 of 2", new=True):
        polished, errors = polish(fit, solution, frames, attend)
    improved = fit.report(polished, force=force)
    return replace(improved if errors.accepted and improved.accepted else refined, photometric=errors)


def refine_matches(
    rig: Rig,
    frames: Sequence[Pairs],
    *,
    free: Iterable[str] = FREE,
    sigma: Mapping[str, float] | None = None,
    force: bool = False,
    keep_depth: bool = True,
) -> Refinement:
    """Refine a rig by matched points, without the photometric error.

    Args:
        frames: matched points of each frame, by pair of names.
        free: free parameters: kinds such as "rotation" or "focal", or patterns over "camera.kind".
        sigma: prior standard deviations by kind, in the rig's units; None for the usual ones (`SIGMA`).
        force: True to accept a result in spite of objections.
        keep_depth: False for a rig whose depths are only assumed: they may change in any way, and nothing is
            refused.

    Returns:
        The refined rig if accepted, else the given one, with changes and objections.

    Raises:
        ValueError: for a rig that relates none of the pairs, points of which none are left to use, or nothing
            free.
    """
    if not keep_depth:
        problem = RefinementProblem.from_frames(rig, free, frames=frames, sigma=sigma)
        return problem.report(problem.solve_freely(), force=True)
    fit, solution = fitted(rig, frames, free=free, sigma=sigma)
    return fit.report(solution, force=force)


def fitted(
    rig: Rig, frames: Sequence[Pairs], *, free: Iterable[str], sigma: Mapping[str, float] | None
) -> tuple[RefinementProblem, Solution]:
    """Fit a rig to matched points, with more free parameters if held-out points improve.

    Those are focal lengths and translations, if `free` is the default, and lenses of views known by F.

    Args:
        frames: matched points of each frame, by pair of names.
        free: free parameters: kinds or patterns.
        sigma: prior standard deviations by kind; None for the usual ones (`SIGMA`).

    Returns:
        The problem that was solved, and its solution.

    Raises:
        ValueError: for a rig that relates none of the pairs, points of which none are left to use, or nothing
            free.
    """
    free = tuple(free)
    candidates = [(rig, free)]
    if free == FREE and any(isinstance(view, Camera) for view in rig.cameras.values()):
        candidates.append((rig, (*FREE, *EXTRA_FREE)))
    if (with_lens := with_lenses(rig)) is not rig:
        candidates.append((with_lens, free))
    problems = [
        RefinementProblem.from_frames(*candidate, frames=frames, sigma=sigma) for candidate in candidates
    ]
    with part(0, 1 / len(problems)):
        best = problems[0], problems[0].solve()
    for i, problem in enumerate(problems[1:], 1):
        if _at_its_best(*best):
            break
        with part(i / len(problems), (i + 1) / len(problems)):
            other = problem, problem.solve()
        distances = [line_distances(fit.after(solution.z), fit.held_out) for fit, solution in (best, other)]
        best = other if nearer(*distances) else best
    return best


def _at_its_best(fit: RefinementProblem, solution: Solution) -> bool:
    """Return True if held-out points of calibrated cameras are as near their lines as those of an F fitted to
    them."""
    if fit.rig.links:
        return False
    rig = fit.after(solution.z)
    return median_off(rig, fit.held_out) < AT_BEST * own_distance(rig, fit.held_out)


@dataclass(frozen=True)
class RefinementProblem:
    """A rig with its parameters and the points for its refinement.

    Attributes:
        rig: the rig before.
        parameters: free parameters.
        used: points to fit, by pair.
        held_out: points to judge by, by pair.
        considered: parameters that are uncertain though not free.
    """

    rig: Rig
    parameters: tuple[FreeParameter, ...]
    used: Pairs
    held_out: Pairs
    considered: tuple[FreeParameter, ...] = ()

    @classmethod
    def from_frames(
        cls,
        rig: Rig,
        free: Iterable[str],
        *,
        frames: Sequence[Pairs],
        sigma: Mapping[str, float] | None = None,
    ) -> RefinementProblem:
        """Split the frames' points into used and held-out ones, and list the free and considered parameters.

        Args:
            free: free parameters: kinds or patterns.
            frames: matched points of each frame, by pair of names.
            sigma: prior standard deviations by kind; None for the usual ones (`SIGMA`).

        Returns:
            The problem.

        Raises:
            ValueError: if nothing is free, no pair is related by the rig, or no points are left to use.
        """
        used, held_out = split([related(rig, pairs) for pairs in frames])
        names = cameras_of(rig, (*used, *held_out))
        parameters = free_parameters(rig, names, free=free, sigma=sigma)
        if not parameters:
            raise ValueError("nothing is free: the first camera keeps its pose; free more, such as centre")
        considered = considered_parameters(rig, names, parameters, sigma=sigma)
        return cls(rig, tuple(parameters), used, held_out, tuple(considered))

    def after(self, z: Float[Tensor, " n"]) -> Rig:
        """Return the rig after a change of z, in prior deviations; of considered parameters too if z has
        them."""
        parameters = (*self.parameters, *self.considered)[
            : len(self.parameters) if len(z) == self.count else None
        ]
        return apply_change(self.rig, parameters, z)

    @property
    def count(self) -> int:
        """Number of free parameters."""
        return sum(len(u.sigma) for u in self.parameters)

    @property
    def uncertain(self) -> int:
        """Number of free and considered parameters of cameras."""
        return self.count + sum(len(u.sigma) for u in self.considered)

    def solve(self) -> Solution:
        """Compute the posterior given the used points, without changes of depth that these do not determine.

        If depth still changes by more than they determine it, every avoidable change of depth is left out.

        Returns:
            The solution, in prior deviations; `directions` span the changes made.
        """
        systematic = systematic_columns(self.rig, self.used)
        log_step(LOG, 0, "refining %d parameters by %d points", self.count, len(systematic))
        columns = systematic.split([len(matches.alpha) for matches in self.used.values()])

        def residuals(z: Tensor) -> list[Tensor]:
            distances = sampson_of_pairs(self.after(z[: self.uncertain]), self.used)
            return [distance + block @ z[self.uncertain :] for distance, block in zip(distances, columns)]

        considered = self.uncertain - self.count + systematic.shape[1]
        unrestricted = solve(residuals, self.count, considered)
        determined = self._determined(unrestricted, residuals)
        if (depth := self._depth_change(self.after(determined.z), determined)) is not None and depth.doubtful:
            determined = self._determined(unrestricted, residuals, keep_depth=True)
        return determined

    def solve_freely(self) -> Solution:
        """Compute the posterior given the used points, however depth changes."""
        return solve(lambda z: sampson_of_pairs(self.after(z), self.used), self.count)

    def _determined(self, solution: Solution, residuals: Residuals, *, keep_depth: bool = False) -> Solution:
        """Return the solution without the modes of depth that the points do not determine.

        Repeated with the modes at that solution, as those of the given rig hold only near it.
        """
        if not bool(solution.active.any()):
            return solution
        active = torch.ones(len(solution.full), dtype=torch.bool)
        active[: self.count] = solution.active
        shifts = shifts_left_out(residuals, solution.full, image_parts(self.rig, self.used), active)
        determined = solution._replace(z=torch.zeros_like(solution.z))
        for _ in range(2):
            values = log_depths(self.after, [self.rig, self.after(determined.z)], self.used)
            if values is None:
                return solution
            G = jacobian(values, determined.z)[1][:, solution.active]
            covariance = solution.covariance[solution.active][:, solution.active]
            modes = depth_modes(G, solution.z[solution.active], covariance, shifts[:, : G.shape[1]])
            kept = modes.deviation < NEGLIGIBLE if keep_depth else modes.kept
            patterns = torch.nn.functional.normalize(G @ modes.root[:, ~kept], dim=0)
            determined = self._without_patterns(solution, active, patterns, residuals, values)
            directions = torch.zeros(self.count, int(kept.sum()), dtype=torch.float64)
            directions[solution.active] = modes.root[:, kept]
            determined = determined._replace(
                directions=directions, gained=modes.gained(kept), known=modes.total
            )
        return determined

    def _without_patterns(
        self,
        solution: Solution,
        active: Bool[Tensor, " k"],
        patterns: Float[Tensor, "m p"],
        residuals: Residuals,
        log_depth: Residuals,
    ) -> Solution:
        """Return the solution with the most probable `active` parameters that keep these patterns
        of depth."""
        start = torch.zeros_like(solution.full)
        before = Evaluated.at(start[: self.count], log_depth).values
        noise = noise_scale(Evaluated.at(solution.full, residuals).values)
        tight = noise / (UNCHANGED * len(before) ** 0.5)

        def constrained(full: Tensor) -> list[Tensor]:
            (depth,) = log_depth(full[: self.count])
            return [*residuals(full), tight * (patterns.T @ (depth - before))]

        basis = torch.eye(len(start), dtype=start.dtype)[:, active]
        full = most_probable(constrained, start, basis, steps=12)
        return solution._replace(z=full[: self.count])

    def report(self, solution: Solution, *, force: bool = False) -> Refinement:
        """Report a solution's changes, and whether held-out points, the prior and depth's uncertainty support
        it.

        Args:
            force: accept it in spite of objections.

        Returns:
            The refinement; its rig is the given one unless accepted.
        """
        refined = self.after(solution.z)
        before, after = (line_distances(rig, self.held_out) for rig in (self.rig, refined))
        depth = self._depth_change(refined, solution)
        moved = bool(solution.z.any())
        objections = [] if moved and nearer(before, after) else [self._no_nearer(before, solution)]
        objections += _contradictions(self.parameters, solution.z)
        off = float(after.abs().median())
        if moved and off > max(LARGEST_DISTANCE, OF_OWN * own_distance(refined, self.held_out)):
            objections.append(
                f"points still lie {off:.1f} px from their lines: "
                "the rig has not drifted, see `pat rig doctor`"
            )
        objections += [] if depth is None else depth.objections()
        if (behind := share_outside(refined.replace(depth=None), self.used)) > MOST_BEHIND:
            mistake = "is it swapped, or does it face the other way? See `pat rig doctor`"
            objections.append(f"{behind:.0%} of the points lie behind a camera: {mistake}")
        if not objections and depth is not None and depth.change > NEGLIGIBLE:
            objections += self._explained_by_lenses(after)
        accepted = moved and (force or not objections)
        return Refinement(
            rig=_with_maps(refined, self.used) if accepted else self.rig,
            accepted=accepted,
            changes=tuple(_changes(self.parameters, solution)) if accepted else (),
            unobservable=tuple(_unobservable(self.parameters, solution.active)),
            held_out=(
                LineStatistics(len(before), float(before.abs().median())),
                LineStatistics(len(after), off),
            ),
            depth=depth,
            objections=tuple(objections),
            kept=tuple(_kept(self.parameters, solution)),
        )

    def _no_nearer(self, before: Tensor, solution: Solution) -> str:
        """Return the objection that points are no nearer to their lines, and what else to free if that is the
        reason."""
        text = "held-out points are no nearer to their lines"
        kinds = dict.fromkeys(u.name.rpartition(".")[2] for u in self.considered)
        if not kinds.keys() & set(FREE):  # else all that can be freed was tried
            return text
        with_considered = self.after(solution.full[: self.uncertain])
        if not nearer(before, line_distances(with_considered, self.held_out)):
            return text
        return f"{text} by what is free alone: free {', '.join(kinds)} too"

    def _explained_by_lenses(self, distances: Tensor) -> list[str]:
        """Return an objection if other lenses, with the same poses, put held-out points as near to their
        lines.

        Images do not distinguish the two then, and the poses would change depth.
        """
        if any(u.name.endswith(".distortion") for u in self.parameters) or self.rig.links:
            return []
        rig = with_distortion(self.rig)
        names = cameras_of(rig, self.used)
        lenses = free_parameters(rig, names, free=["distortion"], sigma={"distortion": LEFT_OUT_SIGMA})
        lens_alone = replace(self, rig=rig, parameters=tuple(lenses), considered=())
        explained = lens_alone.after(lens_alone.solve_freely().z)
        if nearer(line_distances(explained, self.held_out), distances):
            return []
        all_kinds = ",".join((*FREE, *EXTRA_FREE, "distortion"))
        freed = f"if those may be wrong, free {all_kinds}"
        what_to_do = freed if rig is self.rig else "state the lenses that were calibrated"
        return [
            f"other lenses explain the points as well as other poses, which would change depth: {what_to_do}"
        ]

    def _depth_change(self, refined: Rig, solution: Solution) -> DepthChange | None:
        """Return the change of depth; None for uncalibrated rigs and for too few points whose depth is
        observable."""
        if (values := log_depths(self.after, [self.rig], self.used)) is None:
            return None
        _, G = jacobian(values, torch.zeros(self.uncertain, dtype=torch.float64))
        before = float(G.square().sum(1).mean().sqrt())
        after = max(before**2 - solution.gained, 0.0) ** 0.5
        return DepthChange(relative_change(self.rig, refined, self.used), before, after, solution.known)


def _contradictions(parameters: Sequence[FreeParameter], z: Tensor) -> list[str]:
    """Return an objection for each parameter vector that changes by more than its prior allows."""
    contradictions = []
    for u, change_of in zip(parameters, z.split([len(u.sigma) for u in parameters])):
        change = u.root @ change_of
        worst = int((change / u.sigma).abs().argmax())
        ratio = float((change / u.sigma)[worst].abs())
        if ratio > LARGEST_CHANGE and u.unit != "F":
            size, sigma = (float(v[worst]) * u.factor for v in (change, u.sigma))
            contradictions.append(
                f"{u.label(worst)} would change by {f'{size:+.3g} {u.unit}'.rstrip()}, "
                f"{ratio:.0f} standard deviations of {sigma:.3g}: is something else wrong (`pat rig "
                "doctor`)? If so large a change is plausible, say so by a larger sigma"
            )
    return contradictions


def systematic_columns(rig: Rig, pairs: Pairs) -> Float[Tensor, "m s"]:
    """Compute derivatives of all Sampson distances by the distortion that lens models leave uncorrected.

    Returns:
        One row a point, four columns a camera, in pixels per prior deviation (`SYSTEMATIC`); 0 for pairs
        known by F.
    """
    names = [name for name in cameras_of(rig, pairs) if isinstance(rig[name], Camera)]
    columns = {name: slice(4 * i, 4 * i + 4) for i, name in enumerate(names)}
    parts = []
    for pair, matches in pairs.items():
        rows = torch.zeros(len(matches.alpha), 4 * len(names), dtype=torch.float64)
        if rig.pair(*pair).link is None and all(name in columns for name in pair):
            for name, modes in zip(pair, systematic_modes(rig.pair(*pair), matches)):
                rows[:, columns[name]] = SYSTEMATIC * modes
        parts.append(rows)
    return torch.cat(parts)


def polish(
    fit: RefinementProblem, solution: Solution, frames: Sequence[Images], attend: Attend
) -> tuple[Solution, PhotometricResult]:
    """Minimise the photometric error of the fusion, with the solution of the points as its prior.

    Errors are scaled by their own deviation and count as one measurement per `CORRELATED_PIXELS` pixels, as
    neighbours are correlated.

    Args:
        fit: problem that the points were fitted to.
        solution: its solution; only its `directions` change further.
        frames: images (C, H, W) in 0..1 by camera, of each frame.
        attend: attention operator (`pat.attention.attend_with_statistics`).

    Returns:
        The solution, and the errors; accepted if the error on held-out pixels falls and held-out points are
        not significantly worse.
    """
    rig = fit.after(solution.z)
    depth = depth_seen(rig, fit.used) if rig.depth is None else rig.depth
    base = replace(fit, rig=fit.rig.replace(depth=depth))
    views = [{name: PhotometricImage.from_image(image) for name, image in frame.items()} for frame in frames]
    root = solution.directions
    done, total = count(), EVALUATIONS * len(views) * len(fit.used)

    def errors(z: Tensor, *, held_out: bool) -> Tensor:
        parts = []
        for view, names in product(views, fit.used):
            log_step(LOG, min(next(done) / total, 0.95), "photometric error of %s and %s", *names)
            parts.append(photometric_errors(base.after(z), view, names, attend))
        return torch.cat([error[valid & (held_out_pixels(error) == held_out)] for error, valid in parts])

    noise = noise_scale(errors(solution.z, held_out=False).detach())
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


def _with_maps(rig: Rig, pairs: Pairs) -> Rig:
    """Return the rig with a rough map for links that have none, by their points."""
    links = dict(rig.links)
    for names, matches in pairs.items():
        if names in links and links[names].H is None and len(matches.alpha) >= ENOUGH:
            links[names] = with_map(rig.pair(*names), matches).link
    return rig.replace(links=links)


def _changes(parameters: Sequence[FreeParameter], solution: Solution) -> Iterable[ParameterChange]:
    for u, end in zip(parameters, accumulate(len(u.sigma) for u in parameters)):
        mine = slice(end - len(u.sigma), end)
        if bool(solution.active[mine].any()):
            amount = u.factor * (u.root @ solution.z[mine])
            deviation = u.factor * (u.root @ solution.covariance[mine, mine] @ u.root.T).diagonal().sqrt()
            yield ParameterChange(u.name, tuple(amount.tolist()), tuple(deviation.tolist()), u.unit)


def _kept(parameters: Sequence[FreeParameter], solution: Solution) -> Iterable[str]:
    """Yield as many parameters as there are combinations that keep their values: those with the largest part
    in them.

    They are the same for any basis of these combinations: pivots of an orthogonal decomposition.
    """
    active = solution.active
    root = torch.linalg.cholesky(solution.covariance[active][:, active])
    moved = torch.linalg.lstsq(root, solution.directions[active]).solution
    parts = root @ torch.linalg.svd(moved).U[:, moved.shape[1] :]
    every = [u.label(i) for u in parameters for i in range(len(u.sigma))]
    labels = [label for label, free in zip(every, active.tolist()) if free]
    pivots = qr(parts.T.numpy(), mode="r", pivoting=True)[1] if parts.numel() else ()
    return (labels[i] for i in pivots[: parts.shape[1]])


def _unobservable(parameters: Sequence[FreeParameter], active: Tensor) -> Iterable[str]:
    for u, mine in zip(parameters, active.split([len(u.sigma) for u in parameters])):
        if not bool(mine.any()):
            yield u.name
        else:
            yield from (u.label(i) for i, free in enumerate(mine.tolist()) if not free)
