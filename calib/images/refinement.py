"""Refinement of a rig by points matched between ordinary images, and a prior of its parameters.

The free parameters z, in units of their prior standard deviations (of a calibration, say), minimise

    sum_i log(1 + (r_i(z) / s)^2) + sum_k z_k^2

with r the Sampson distances of matched points (Hartley & Zisserman 11.4.3) and s the scale of the points'
noise: Gauss-Newton steps on automatic derivatives through `arraygeom`, reweighted (Cauchy's loss). The rest
(other parameters of the cameras, and what their lens models leave) is uncertain all the same and takes its
share of the residuals. Parameters that the images do not determine keep their values, and depth, as given, is
evidence too (`depth_change`). Held-out points, the prior and the change of depth decide whether the result is
accepted.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Camera, Rig
from arraygeom.runtime.progress import log_step, part, stage
from arraygeom.runtime.threads import torch_in_one_thread

from .depth_change import DEPTH_KEPT, DepthChange, log_depths, relative_change, share_outside
from .explanations import undetermined
from .least_squares import (
    Residuals,
    Solution,
    jacobian,
    most_probable,
    solve,
)
from .lenses import with_lenses
from .matches import (
    ENOUGH,
    MATCHING_SHARE,
    Images,
    Pairs,
    agreeing_pairs,
    cameras_of,
    image_sizes,
    match_cameras,
    with_map,
)
from .parameters import (
    LARGEST_CHANGE,
    UNCERTAIN,
    FreeParameter,
    apply_change,
    considered_parameters,
    free_parameters,
)
from .refined import LineStatistics, ParameterChange, Refinement
from .residuals import (
    line_distances,
    nearer,
    own_distance,
    related,
    sampson_of_pairs,
    split,
    systematic_modes,
)

LOG = logging.getLogger(__name__)

FREE = UNCERTAIN
"""Kinds of parameters that are free by default."""
SYSTEMATIC = 0.3
"""Prior deviation, pixels at the image's corner, of each smooth displacement that a lens model leaves."""
LARGEST_DISTANCE, OF_OWN = 1.0, 3.0
"""Largest median distance of held-out points from their lines, in pixels, and as a multiple of their distance
from the lines of an F fitted to them; a refined rig beyond both is refused."""
MOST_BEHIND = 0.5
"""Largest share of points behind a camera: some wrong matches always are."""


@torch_in_one_thread()
@stage()
def refine(
    rig: Rig,
    frames: Sequence[Images],
    *,
    free: Iterable[str] = FREE,
    sigma: Mapping[str, float] | None = None,
    force: bool = False,
    matches: Sequence[Pairs] | None = None,
) -> Refinement:
    """Refine a rig by points matched in frames, each with images of two or more of its cameras.

    The rig's first camera that has matched points keeps its pose. F of links is always free, and views known
    by F alone are given lenses if held-out points improve. With two frames or more, whole frames are held
    out, else parts of the image.

    Args:
        rig: the rig, not a batch.
        frames: one image (C, H, W) in 0..1 per camera, by name, of the rig's sizes.
        free: free parameters, as `free_parameters` takes them: kinds such as "rotation" or "focal", or
            patterns over "camera.kind".
        sigma: prior standard deviations by kind, in the units of `SIGMA` (radians, pixels, shares of the
            longest baseline and of the focal length); None for the usual ones.
        force: True to follow the lines however depth changes, and accept the result in spite of objections,
            unless nothing moved.
        matches: points used instead of matching images, for each frame; None to match them.

    Returns:
        The refined rig if accepted, else the given one, with changes and objections.

    Raises:
        ValueError: in one line, for no frame, an image of another size than the rig states, images that
            `match_cameras` refuses, given points of which too few agree, `matches` of another number of
            frames, and as `refine_matches`.
    """
    if not frames:
        raise ValueError("no frame: give images of two cameras or more")
    if matches is not None and len(matches) != len(frames):
        raise ValueError(f"matches of {len(matches)} frames for images of {len(frames)}: give them for each")
    for name, (height, width) in (item for frame in frames for item in image_sizes(frame).items()):
        h, w = rig[name].hw
        if (height, width) != (h, w):
            raise ValueError(
                f"the image of '{name}' is {width}x{height}, the rig states {w}x{h}: "
                "`pat rig doctor` finds the reason"
            )
    pairs = []
    for i, frame in enumerate(frames):
        with part(MATCHING_SHARE * i / len(frames), MATCHING_SHARE * (i + 1) / len(frames)):
            pairs.append(match_cameras(frame) if matches is None else agreeing_pairs(matches[i]))
    with part(MATCHING_SHARE, 1):
        return refine_matches(rig, pairs, free=free, sigma=sigma, force=force)


def refine_matches(
    rig: Rig,
    frames: Sequence[Pairs],
    *,
    free: Iterable[str] = FREE,
    sigma: Mapping[str, float] | None = None,
    force: bool = False,
    keep_depth: bool = True,
) -> Refinement:
    """Refine a rig by matched points.

    Args:
        frames: matched points of each frame, by pair of names; pairs that the rig does not relate by lines
            are left out.
        free: free parameters: kinds such as "rotation" or "focal", or patterns over "camera.kind".
        sigma: prior standard deviations by kind, as `refine` takes them; None for the usual ones.
        force: True to follow the lines however depth changes, and accept the result in spite of objections.
        keep_depth: False for a rig whose depths are only assumed: nothing but the free parameters is
            uncertain then, no view is given a lens, depth may change in any way, and nothing is refused,
            whatever `force` says.

    Returns:
        The refined rig if accepted, else the given one, with changes and objections; where nothing moved it
        is not accepted, whatever was forced. The first camera keeps its pose.

    Raises:
        ValueError: for no frames, a camera that the rig lacks, a frame of whose pairs it relates none, a
            single frame's points all in one spot, nothing free, `free` or `sigma` that `free_parameters`
            refuses, and as `with_map` for a link that has no H.
    """
    if not keep_depth:
        problem = RefinementProblem.from_frames(rig, free, frames=frames, sigma=sigma)
        return problem.report(problem.solve_freely(), force=True)
    fit, solution = fitted(rig, frames, free=free, sigma=sigma, near_depth=not force)
    found = fit.report(solution, force=force)
    return found if found.accepted else dataclasses.replace(found, rig=rig)


def fitted(
    rig: Rig,
    frames: Sequence[Pairs],
    *,
    free: Iterable[str],
    sigma: Mapping[str, float] | None,
    near_depth: bool = True,
) -> tuple[RefinementProblem, Solution]:
    """Fit a rig to matched points; with lenses for views known by F alone if held-out points come nearer.

    Args:
        frames: matched points of each frame, by pair of names.
        free: free parameters: kinds or patterns.
        sigma: prior standard deviations by kind, as `refine` takes them; None for the usual ones.
        near_depth: False to let depth change in any way.

    Returns:
        The problem that was solved, whose `rig` may have got lenses without distortion, and its solution.

    Raises:
        ValueError: as `refine_matches`.
    """
    free, best = tuple(free), None
    rigs = [rig] if (with_lens := with_lenses(rig)) is rig else [rig, with_lens]
    for i, each in enumerate(rigs):
        problem = RefinementProblem.from_frames(each, free, frames=frames, sigma=sigma)
        with part(i / len(rigs), (i + 1) / len(rigs)):
            found = problem, problem.solve(near_depth=near_depth)
        if best is None or nearer(
            *(line_distances(fit.after(solution.z), fit.held_out) for fit, solution in (best, found))
        ):
            best = found
    assert best is not None
    return best


@dataclass(frozen=True)
class RefinementProblem:
    """A rig with its parameters and the points for its refinement.

    Attributes:
        rig: the rig before.
        parameters: free parameters.
        used: points to fit, by pair.
        held_out: points to judge by, by pair; pairs with few points may lack.
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
        """Make the problem of a rig: split the frames' points into used and held-out ones, and list the free
        and considered parameters.

        Args:
            free: free parameters: kinds or patterns.
            frames: matched points of each frame, by pair of names.
            sigma: prior standard deviations by kind, as `refine` takes them; None for the usual ones.

        Raises:
            ValueError: as `refine_matches`.
        """
        used, held_out = split([related(rig, pairs, by_lines=True) for pairs in frames])
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

    def solve(self, *, near_depth: bool = True) -> Solution:
        """Compute the posterior given the used points and, if `near_depth`, their depth by the given rig.

        Returns:
            The solution, in prior deviations; its `depth` is None if fewer than `FEW` points have a depth, or
            nothing is observable.
        """
        systematic = systematic_columns(self.rig, self.used)
        log_step(LOG, 0, "refining %d parameters by %d points", self.count, len(systematic))
        columns = systematic.split([len(matches.alpha) for matches in self.used.values()])

        def residuals(z: Tensor) -> list[Tensor]:
            distances = sampson_of_pairs(self.after(z[: self.uncertain]), self.used)
            return [distance + block @ z[self.uncertain :] for distance, block in zip(distances, columns)]

        considered = self.uncertain - self.count + systematic.shape[1]
        solution = solve(residuals, self.count, considered)
        suggested = self.after(solution.z)
        values = log_depths(self.after, [self.rig, suggested], self.used)
        if values is None or not bool(solution.active.any()):
            return solution
        solution = solution._replace(depth=relative_change(self.rig, suggested, self.used))
        return self._near_depth(solution, residuals, values) if near_depth else solution

    def solve_freely(self) -> Solution:
        """Compute the posterior given the used points, however depth changes."""
        return solve(lambda z: sampson_of_pairs(self.after(z), self.used), self.count)

    def _near_depth(self, solution: Solution, residuals: Residuals, log_depth: Residuals) -> Solution:
        """Return the most probable parameters if the points' depth, as given, is known to `DEPTH_KEPT`."""
        free = solution.active
        G = jacobian(log_depth, torch.zeros_like(solution.z))[1][:, free] / DEPTH_KEPT
        information = G.T @ G / len(G) + torch.eye(G.shape[1], dtype=G.dtype)
        parameters = torch.eye(len(solution.full), dtype=G.dtype)
        root = torch.block_diag(
            torch.linalg.cholesky(torch.linalg.inv(information)),
            torch.eye(len(solution.full) - self.count, dtype=G.dtype),
        )
        kept = torch.cat([free, torch.ones(len(solution.full) - self.count, dtype=torch.bool)])
        to_full = parameters[:, kept] @ root
        y = torch.linalg.solve_triangular(root, solution.full[kept, None], upper=False)[:, 0]
        y = most_probable(lambda y: residuals(to_full @ y), y, torch.eye(len(y), dtype=G.dtype))
        return solution._replace(z=(to_full @ y)[: self.count])

    def report(self, solution: Solution, *, force: bool = False) -> Refinement:
        """Report a solution's changes, and whether held-out points, the prior and depth's uncertainty support
        it.

        Args:
            solution: solution of this problem.
            force: True to accept it in spite of objections, unless nothing moved.

        Returns:
            The refinement; its rig is that of the problem unless accepted.
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
            undetermined=undetermined(refined, self.used),
        )

    def _no_nearer(self, before: Tensor, solution: Solution) -> str:
        """Return the objection that points are no nearer to their lines, and what to free if that helps."""
        text = "held-out points are no nearer to their lines"
        kinds = dict.fromkeys(u.name.rpartition(".")[2] for u in self.considered)
        if not kinds.keys() & set(FREE):  # else all that can be freed was tried
            return text
        with_considered = self.after(solution.full[: self.uncertain])
        if not nearer(before, line_distances(with_considered, self.held_out)):
            return text
        return f"{text} by what is free alone: free {', '.join(kinds)} too"

    def _depth_change(self, refined: Rig, solution: Solution) -> DepthChange | None:
        """Return the change of depth; None without calibration or observable depths."""
        if solution.depth is None:
            return None
        return DepthChange(relative_change(self.rig, refined, self.used), solution.depth)


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
        One row a point, the pairs' one after the other, and four columns a calibrated camera of the pairs in
        the rig's order, float64 without gradient, in pixels per prior deviation (`SYSTEMATIC`); 0 for pairs
        known by F.

    Raises:
        ValueError: for a camera that the rig lacks.
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


def _unobservable(parameters: Sequence[FreeParameter], active: Tensor) -> Iterable[str]:
    for u, mine in zip(parameters, active.split([len(u.sigma) for u in parameters])):
        if not bool(mine.any()):
            yield u.name
        else:
            yield from (u.label(i) for i, free in enumerate(mine.tolist()) if not free)
