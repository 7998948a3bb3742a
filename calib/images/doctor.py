"""Diagnosis of the usual mistakes in a rig by points matched between one image of each camera."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from statistics import fmean
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from scipy.spatial import Delaunay, QhullError
from torch import Tensor
from torch.nn.functional import normalize

from arraygeom import Camera, LensView, Pair, Rig
from arraygeom.pixels import HW
from arraygeom.pose import rotation_vector
from arraygeom.rig import Depths
from arraygeom.robust import cauchy, least_squares, robust_least_squares
from arraygeom.threads import torch_in_one_thread

from .depth_change import relative_change
from .evidence import SCALES, DriftEvidence
from .held_out import image_parts, line_distances, trimmed_square
from .matches import Images, Pairs, PointMatches, agreeing_pairs, match_cameras, seen_depths
from .parameters import SIGMA
from .remedies import (
    NOTHING,
    TURNS,
    Remedy,
    bare_cameras,
    degrees_remedy,
    from_degrees,
    lens_remedy,
    remedies,
)
from .residuals import lines_basis, related, residuals_and_depths, stack_key, stacked

LOG = logging.getLogger(__name__)

MOST = 250
"""Largest number of matches used of a pair."""
LARGEST_DISTANCE = 1000.0
"""Upper bound of a match's distance from its line, pixels; also for pixels without a ray."""
HEALTHY_MISFIT = 0.2
"""A rig with a smaller misfit than this, in pixels, is healthy."""
OF_TRIMMED = 0.52
"""`trimmed_square` of normal points of variance 1."""
EQUAL = (1.4, 0.03)
"""Explanations are equal whose misfit is less than 1.4 times the best one's plus 0.03 px."""
WRONG_SIDE_PENALTY = 100.0
"""Penalty, pixels, of points behind the cameras, outside the depth range, or mirrored."""
LARGEST_REMAINDER = (0.33, 0.2)
"""A mistake is named if its remedy leaves no more than the first share of the misfit: many wrong remedies
improve a drifted rig somewhat. Nor is one as good as another that leaves less than the second share of what
it leaves."""
MARGIN, TIE = 12.0, 2.0
"""A mistake is named if -2 log evidence is smaller by this than that of a drift, and others are as good that
have less than this more; of those within the second, the likely one is named."""
MOST_COMPARED = 10
"""Explanations whose evidence is computed: those that leave least."""
EXPLAINED, ROUGHLY = (2 * HEALTHY_MISFIT, 0.06), 0.9
"""A mistake explains the points if no more than so many pixels, or that share of the misfit, are left; pixels
of those whose remedy is approximate."""
SAME_DEPTH, SAME_DISTANCE = 1e-3, 1e-3
"""Rigs are the same whose depths (relative) and distances from lines (pixels) differ by less, in median."""
LEAST_NOISE = 0.05
"""Lower bound of the points' noise, pixels."""
FEW = 10
"""Least number of points for a share."""
BARREL, PINCUSHION = -0.6, 0.4
"""Bounds of k1 times the squared radius of the farthest corner, at z = 1."""


class FitStatistics(NamedTuple):
    """Statistics of matched points under a rig.

    off: median distance in pixels of a point from its epipolar line.
    misfit: the part of it (root mean square, pixels) that is due to the rig and not to the matches' noise.
    front: share of the points in front of both cameras, of those whose depth is observable.
    inside: share of those in front that lie in the rig's depth range; NaN without one.
    handed: share of the triangles of neighbouring points whose orientation changes between the images, or
    not, as the rig implies: mirrored images change it.
    depth: median depth in metres of the points in front; NaN if too few.
    """

    off: float
    misfit: float
    front: float
    inside: float
    handed: float
    depth: float = math.nan

    @property
    def penalised_misfit(self) -> float:
        """The misfit plus penalties, pixels."""
        wrong = (self.front < 0.5) + (self.inside < 0.5) + (self.handed < 0.5)
        return self.misfit + WRONG_SIDE_PENALTY * wrong

    def __str__(self) -> str:
        parts = [f"{self.off:.2f} px from the lines, {self.misfit:.2f} px of it due to the rig"]
        if not math.isnan(self.front):
            parts.append(f"{self.front:.0%} in front")
        if not math.isnan(self.inside):
            parts.append(f"{self.inside:.0%} within the depth range")
        if not math.isnan(self.depth):
            parts.append(f"median depth {self.depth:.3g} m")
        if self.handed < 0.5:
            parts.append("one image mirrored relative to the other")
        return ", ".join(parts)


@dataclass(frozen=True)
class Diagnosis:
    """The result of a diagnosis.

    named: the mistake, or `NOTHING`: no mistake explains the images clearly better than a drift of the
    cameras does. equal: other kinds of mistake that explain the images as well.
    before, after: statistics of the given rig and of the repaired one. tried: all explanations, best first.
    matches: number of points used. healthy: the given rig fits the images. certain: all explanations that are
    as good as the one named are undone by the same rig.
    """

    named: Remedy
    equal: tuple[Remedy, ...]
    before: FitStatistics
    after: FitStatistics
    tried: tuple[tuple[Remedy, FitStatistics], ...]
    matches: int
    healthy: bool
    repaired: Rig
    certain: bool

    @property
    def verdict(self) -> str:
        """The diagnosis in a sentence or two."""
        others = "; or: ".join(remedy.words for remedy in self.equal)
        if self.named.kind != "nothing":
            return f"likely mistake: {self.named.words}" + (f"; or: {others}" if others else "")
        if self.healthy:
            return "nothing wrong: the points lie on their lines to the accuracy of their positions"
        return (
            f"none of the usual mistakes, but the rig is {self.before.misfit:.2f} px off these images: "
            "it has drifted or was inaccurate from the beginning; "
            "`pat rig refine` may repair what can be observed"
        ) + (f". As plausible as a drift, but not more: {others}" if others else "")

    def as_text(self) -> str:
        """The verdict, and the statistics before and after, as text."""
        lines = [self.verdict, f"as given: {self.before}"]
        if self.named.kind != "nothing":
            lines.append(f"repaired: {self.after}")
        return "\n".join([*lines, f"from {self.matches} points seen in two images"])

    def as_json(self) -> str:
        """The same as JSON, with the ten best explanations."""
        tried = [{"kind": r.kind, "words": r.words, **_rounded(f)} for r, f in self.tried[:10]]
        document = {
            "verdict": self.verdict,
            "mistake": self.named.kind,
            "words": self.named.words,
            "as_good": [{"mistake": remedy.kind, "words": remedy.words} for remedy in self.equal],
            "healthy": self.healthy,
            "matches": self.matches,
            "before": _rounded(self.before),
            "after": _rounded(self.after),
            "tried": tried,
        }
        return json.dumps(document, indent=2)


def _rounded(figures: FitStatistics) -> dict[str, float | None]:
    return {name: None if math.isnan(value) else round(value, 4) for name, value in figures._asdict().items()}


@torch_in_one_thread()
def diagnose(rig: Rig, images: Images, matches: Pairs | None = None) -> Diagnosis:
    """Find the usual mistake, if any, in a rig, by one image (C, H, W) of two or more of its cameras.

    `matches` are taken in place of those that would be found.

    Raises ValueError, one line, for a camera that the rig lacks, fewer than two images, equal ones, and
    images in which too few points match; and for a rig that does not relate its cameras.
    """
    for name in images:
        rig.require(name)
    sizes = {name: (int(image.shape[1]), int(image.shape[2])) for name, image in images.items()}
    return diagnose_matches(rig, sizes, match_cameras(images) if matches is None else agreeing_pairs(matches))


def diagnose_matches(rig: Rig, sizes: Mapping[str, HW], pairs: Pairs) -> Diagnosis:
    """`diagnose` from matched points of images of these sizes."""
    pairs = {names: _thinned(matches) for names, matches in related(rig, pairs).items()}
    fits = all(rig[name].hw == hw for name, hw in sizes.items())
    tried = [r for r in remedies(rig, sizes) if not fits or r.is_plausible(rig)]
    tried = [NOTHING, *tried]
    if fits:
        tried += [*_ignored_lens(rig, pairs), *_degrees(rig, pairs), *_depth_range(rig, pairs)]
    LOG.info("trying %d mistakes on %d pairs", len(tried), len(pairs))
    figures, inliers, noise = _evaluate(rig, tried, pairs)
    order = sorted(range(0 if fits else 1, len(tried)), key=lambda i: figures[i].penalised_misfit)
    healthy = fits and figures[0].penalised_misfit < HEALTHY_MISFIT
    if not fits:
        least = EQUAL[0] * figures[order[0]].penalised_misfit + EQUAL[1]
        as_good = [i for i in order if figures[i].penalised_misfit <= least]
        best = min(as_good)
    elif healthy:
        best, as_good = 0, []
    else:
        LOG.info("comparing the mistakes that leave least with a drift")
        best, as_good = _by_evidence(rig, tried, figures, order, pairs, inliers, noise)
    equal = {tried[i].kind: tried[i] for i in reversed(as_good)}
    equal.pop(tried[best].kind, None)
    table = tuple((tried[i], figures[i]) for i in order)
    count = sum(len(matches.alpha) for matches in pairs.values())
    repaired = tried[best].repair(rig)
    certain = best > 0 and all(_same_rig(repaired, tried[i].repair(rig), pairs) for i in as_good if i != best)
    return Diagnosis(
        tried[best],
        tuple(equal.values()),
        figures[0],
        figures[best],
        table,
        count,
        healthy,
        repaired,
        certain,
    )


def _by_evidence(
    rig: Rig,
    tried: Sequence[Remedy],
    figures: Sequence[FitStatistics],
    order: Sequence[int],
    pairs: Pairs,
    inliers: Tensor,
    noise: float,
) -> tuple[int, list[int]]:
    """The mistake that explains the points clearly better than a drift of the rig does, 0 if none; all that
    are as good as it, or as the drift, best first.

    Points of one object, or wrong ones in one place, do not decide: it is better without each part of them in
    turn. No drift mirrors an image; one of the principal point does what a small shift of pixels does.
    """
    limit = LARGEST_REMAINDER[0] * figures[0].penalised_misfit
    some = [i for i in order if i and figures[i].penalised_misfit <= limit][:MOST_COMPARED]
    if not some:
        return 0, []
    limit = figures[some[0]].penalised_misfit / LARGEST_REMAINDER[1] + EQUAL[1]
    some = [i for i in some if figures[i].penalised_misfit <= limit]
    found = {i: DriftEvidence.of(tried[i].repair(rig), pairs, inliers, noise) for i in some}
    given = DriftEvidence.of(rig, pairs, inliers, noise)
    mirrored = figures[0].handed < 0.5
    some.sort(key=lambda i: found[i].cost)
    least = found[some[0]].cost
    best = min(i for i in some if found[i].cost <= least + TIE)
    allowed = max(
        ROUGHLY if tried[best].approximate else EXPLAINED[0], EXPLAINED[1] * figures[0].penalised_misfit
    )
    parts = image_parts(rig, pairs)
    rest = (inliers & (parts != part) for part in parts.unique().tolist())
    clear = (
        figures[best].penalised_misfit <= allowed
        and found[best].cost + MARGIN < given.cost
        and all(found[best].by(used) + MARGIN < given.by(used) for used in rest)
    )
    named = mirrored or (clear and (bool(rig.links) or not tried[best].small))
    bound = MARGIN + (least if named else min(least, given.cost))
    near = EQUAL[0] * figures[best].penalised_misfit + EQUAL[1] if named else 0.0
    as_good = [i for i in some if found[i].cost <= bound or figures[i].penalised_misfit <= near]
    return best if named else 0, as_good


def _same_rig(rig: Rig, other: Rig, pairs: Pairs) -> bool:
    """Whether no point tells two rigs apart: by its depth or, if they are not calibrated, by its line."""
    change = relative_change(rig, other, pairs)
    if not math.isnan(change):
        return change < SAME_DEPTH
    off = [line_distances(each, pairs).abs() for each in (rig, other)]
    return bool((off[0] - off[1]).abs().median() < SAME_DISTANCE)


def _thinned(matches: PointMatches) -> PointMatches:
    """At most `MOST` of them, evenly through the list."""
    step = max(1, -(-len(matches.alpha) // MOST))
    return PointMatches(matches.alpha[::step], matches.beta[::step])


def _evaluate(rig: Rig, tried: Sequence[Remedy], pairs: Pairs) -> tuple[list[FitStatistics], Tensor, float]:
    """The statistics of every explanation, from the same points: the inliers of the best of them.

    Those inliers, and the standard deviation of their distances too.
    """
    rigs = [remedy.repair(rig) for remedy in tried]
    observed = _observe(rigs, pairs)
    inliers, floor = _inliers(rig, tried, observed.off, pairs)
    preserved = [handedness(matches) for matches in pairs.values()]
    figures = [
        _figures(
            *(part[i] for part in observed),
            inliers=inliers,
            floor=floor,
            bounds=repaired.depth,
            handed=fmean(abs(share - _mirrors(repaired, names)) for share, names in zip(preserved, pairs)),
        )
        for i, repaired in enumerate(rigs)
    ]
    return figures, inliers, max(math.sqrt(floor / OF_TRIMMED), LEAST_NOISE)


def handedness(matches: PointMatches) -> float:
    """The share of Delaunay triangles of the points in alpha that keep their orientation in beta."""
    try:
        corners = Delaunay(matches.alpha.numpy()).simplices
    except QhullError:
        return 1.0
    areas = [_area(points[torch.from_numpy(corners).long()]) for points in matches]
    return float((areas[0] * areas[1] > 0).double().mean())


def _area(triangles: Tensor) -> Tensor:
    first, second = (triangles[:, i] - triangles[:, 0] for i in (1, 2))
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


def _mirrors(rig: Rig, names: tuple[str, str]) -> bool:
    """Whether exactly one of two cameras is that of a mirrored image."""
    views = [rig[name] for name in names]
    return sum(isinstance(v, LensView) and bool(v.K[:2, :2].det() < 0) for v in views) == 1


class PointObservations(NamedTuple):
    """All points of all pairs (n) under several rigs (k): signed pixels from the line, depth, in front.

    Unobservable depths are NaN.
    """

    off: Float[Tensor, "k n"]
    depth: Float[Tensor, "k n"]
    front: Bool[Tensor, "k n"]


def _observe(rigs: Sequence[Rig], pairs: Pairs) -> PointObservations:
    parts = [_observe_pair([rig.pair(*names) for rig in rigs], matches) for names, matches in pairs.items()]
    return PointObservations(*(torch.cat(part, 1) for part in zip(*parts)))


def _observe_pair(pairs: Sequence[Pair], matches: PointMatches) -> PointObservations:
    """One pair of cameras under several rigs, batched by lens model."""
    count = len(matches.alpha)
    off, depth = torch.full((2, len(pairs), count), torch.nan, dtype=torch.float64)
    front = torch.zeros(len(pairs), count, dtype=torch.bool)
    groups: dict[object, list[int]] = {}
    for i, pair in enumerate(pairs):
        groups.setdefault(stack_key(pair), []).append(i)
    for group in groups.values():
        pair = stacked([pairs[i] for i in group])
        (_, line, valid), depths = residuals_and_depths(pair, matches)
        line = torch.where(valid, line.detach(), LARGEST_DISTANCE)
        off[group] = line.nan_to_num(LARGEST_DISTANCE).clamp(-LARGEST_DISTANCE, LARGEST_DISTANCE)
        if depths is not None:
            depth[group] = torch.where(depths.observable, depths.depth, torch.nan)
            front[group] = depths.front
    return PointObservations(off, depth, front)


def _inliers(rig: Rig, tried: Sequence[Remedy], off: Tensor, pairs: Pairs) -> tuple[Tensor, float]:
    """The points consistent with some pose of the cameras, their mean square distance then, square pixels.

    The pose is free, so only the lens matters: the best explanation that changes it is used.
    """
    fits = []
    for remedy, o in zip(tried, off):
        if remedy.kind in ("nothing", "distortion"):
            repaired = remedy.repair(rig)
            lengths = [len(matches.alpha) for matches in pairs.values()]
            left = [
                _beyond_pose(repaired.pair(*n), m, r) for (n, m), r in zip(pairs.items(), o.split(lengths))
            ]
            fits.append(torch.cat(left))
    left_over = min(fits, key=lambda e: float(e.abs().median()))
    inliers = left_over.abs() <= max(4 * float(left_over.abs().median()), 0.2)
    return inliers, trimmed_square(left_over[inliers])


def _beyond_pose(pair: Pair, matches: PointMatches, off: Tensor) -> Tensor:
    """The residual of the distances after a robust first-order fit of F."""
    terms = lines_basis(pair, matches).T

    def weigh(rest: Tensor) -> Tensor:
        return cauchy(rest, 2 * max(float(rest.abs().median()), 1e-3)).square()

    return robust_least_squares(
        terms, off, least_squares(terms, off, torch.ones_like(off)), weigh, steps=7
    ).rest


def _figures(
    off: Tensor,
    depth: Tensor,
    front: Tensor,
    *,
    inliers: Tensor,
    floor: float,
    bounds: Depths | None,
    handed: float,
) -> FitStatistics:
    off = off[inliers]
    misfit = math.sqrt(max(trimmed_square(off) - floor, 0.0))
    observable = ~depth.isnan()
    share = float(front[observable].double().mean()) if int(observable.sum()) >= FEW else math.nan
    seen = depth[observable & front]
    median = float(seen.median()) if len(seen) >= FEW else math.nan
    return FitStatistics(float(off.abs().median()), misfit, share, _inside(bounds, seen), handed, median)


def _inside(bounds: Depths | None, depth: Tensor) -> float:
    """The share of depths between half the near and twice the far bound."""
    if bounds is None or len(depth) < FEW:
        return math.nan
    near, far = (float(bound) for bound in bounds)
    return float(((depth > 0.5 * near) & (depth < 2 * far)).double().mean())


def _ignored_lens(rig: Rig, pairs: Pairs) -> list[Remedy]:
    """The distortion that best explains the points, for cameras that have none."""
    bare = bare_cameras(rig, {name for names in pairs for name in names})
    if not bare:
        return []
    squared = max(_corner_radius(camera) for camera in bare.values()) ** 2
    lowest, highest = BARREL / squared, PINCUSHION / squared
    k1 = 0.0
    for _ in range(3):
        candidates = torch.linspace(lowest, highest, 13, dtype=torch.float64).tolist()
        off = _observe([lens_remedy(rig, bare, k).repair(rig) for k in candidates], pairs).off
        best = int(off.abs().median(1).values.argmin())
        k1, step = candidates[best], candidates[1] - candidates[0]
        lowest, highest = k1 - step, k1 + step
    return [lens_remedy(rig, bare, k1)]


def _corner_radius(camera: Camera) -> float:
    """Distance from the axis, at z = 1, of the farthest corner."""
    h, w = camera.hw
    corners = camera.K.new_tensor([[0, 0], [w - 1, 0], [0, h - 1], [w - 1, h - 1]])
    return float(camera.rays(corners)[0][:, :2].norm(dim=-1).max())


def _degrees(rig: Rig, pairs: Pairs) -> list[Remedy]:
    """Rotation vectors in degrees, taken for radians, with the lost whole turns that suit points best.

    Not where a drift may be what turned the cameras.
    """
    first, *others = dict.fromkeys(name for names in pairs for name in names)
    if any((first, other) not in pairs or not rig.pair(first, other).calibrated for other in others):
        return []
    turns, cost = {}, torch.zeros(len(TURNS), dtype=torch.float64)
    for other in others:
        off = _off_planes(rig, (first, other), pairs[first, other])
        cost = cost + off.amin(1)
        turns[other] = off.argmin(1)
    best = int(cost.argmin())
    remedy = degrees_remedy({first: TURNS[best]} | {other: TURNS[int(i[best])] for other, i in turns.items()})
    repaired = remedy.repair(rig)
    before, after = ([r.pair(first, other).beta_from_alpha.R for other in others] for r in (rig, repaired))
    angles = [float(rotation_vector(R.mT @ Q).norm()) for R, Q in zip(before, after)]
    return [remedy] if max(angles) > 3 * SCALES[-1] * SIGMA["rotation"] else []


def _off_planes(rig: Rig, names: tuple[str, str], matches: PointMatches) -> Float[Tensor, "k k"]:
    """Sines of the rays of beta with their epipolar planes, medians, by the turns of alpha and of beta."""
    alpha, beta = rig.pair(*names).cameras
    rays = [normalize(camera.rays(points)[0], dim=-1) for camera, points in zip((alpha, beta), matches)]
    of_alpha, of_beta = (from_degrees(camera.R, torch.tensor(TURNS)) for camera in (alpha, beta))
    R = of_beta @ of_alpha[:, None].mT
    t = beta.t - R @ alpha.t
    normals = torch.linalg.cross(t[..., None, :].expand(*R.shape[:2], len(rays[0]), 3), rays[0] @ R.mT)
    sines = (normalize(normals, dim=-1) * rays[1]).sum(-1).abs()
    return sines.nan_to_num(1.0).median(-1).values


def _depth_range(rig: Rig, pairs: Pairs) -> list[Remedy]:
    """The depth range of the points, for a rig that has another."""
    found = []
    for names, matches in pairs.items() if rig.depth is not None else ():
        pair = rig.pair(*names)
        if pair.calibrated and pair.link is None:
            with suppress(ValueError):
                found.append(seen_depths(pair, matches))
    if not found:
        return []
    near, far = min(bounds[0] for bounds in found), max(bounds[1] for bounds in found)
    words = (
        f"the depth range excludes the scene, which is {near:.3g} to {far:.3g} m away: "
        "correct `depth` in the file"
    )
    return [Remedy("depth range", words, lambda rig: rig.replace(depth=(near, far)))]
