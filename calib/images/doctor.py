"""Diagnosis of the usual mistakes in a rig by points matched between one image of each camera."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from arraygeom import Camera, Rig
from arraygeom.pixels import HW, coarse_grid
from arraygeom.pose import rotation_vector
from arraygeom.runtime.text import length_unit
from arraygeom.runtime.threads import torch_in_one_thread

from .depth_change import relative_change, share_outside
from .evidence import SCALES, DriftEvidence, FitStatistics, fit_statistics, observations
from .explanations import undetermined
from .hypotheses import (
    FOCAL_SHARE,
    FOCAL_SPREAD,
    OFF_CENTRE,
    SHIFTS,
    TURNS,
    Hypothesis,
    centred,
    cropped,
    focal_length_of,
    from_degrees,
    hypotheses,
    ignored_lens,
    in_degrees,
    is_short,
    may_be_cropped,
    unlikelihood,
    zoomed,
)
from .least_squares import most_probable
from .matches import (
    ENOUGH,
    Images,
    Pairs,
    PointMatches,
    agreeing_pairs,
    cameras_of,
    depth_seen,
    image_sizes,
    match_cameras,
)
from .parameters import LARGEST_CHANGE, SIGMA, apply_change, free_parameters
from .residuals import image_parts, line_distances, related, sampson_of_pairs, within_lenses

LOG = logging.getLogger(__name__)

MOST = 250
"""Largest number of matches used per pair."""
HEALTHY_MISFIT = 0.2
"""Misfit in pixels below which a rig is healthy."""
USUAL_MISFIT = 0.0015
"""Misfit, as a share of the image's longer side, below which a rig is healthy if no mistake explains it."""
FOCAL_SHARES = (0.3, 3.0)
"""Focal lengths that are tried, lowest and highest, as shares of the image's longer side."""
ROUNDS, UNLIKELY = 3, 0.03
"""Rounds of a search, and pixels that a number costs which is one prior deviation off, for where points do
not determine it."""
EQUAL = (1.4, 0.03)
"""Explanations count as equal whose misfit is less than 1.4 times the best one's plus 0.03 px."""
LARGEST_REMAINDER = (0.33, 0.2)
"""Largest share of the misfit that the rig of a named mistake may leave, as many wrong hypotheses improve a
drifted rig somewhat; and the least share of another explanation's remainder that the best one may leave if
both are to be compared."""
MARGIN, TIE = 12.0, 2.0
"""Lead in -2 log evidence over a drift that a mistake needs to be named, within which others are as good; and
the lead within which the likelier mistake is named. A repair with estimated numbers needs `MARGIN` more."""
MOST_COMPARED = 10
"""Number of explanations whose evidence is computed: those with the least misfit."""
EXPLAINED, ROUGHLY = (2 * HEALTHY_MISFIT, 0.06), 0.9
"""Largest misfit that a named mistake may leave: pixels, or a share of the misfit of the given rig; and the
pixels for hypotheses whose rig is approximate."""
SAME_DEPTH, SAME_DISTANCE = 1e-3, 1e-3
"""Differences below which two rigs are the same: of depths (relative), and of distances from lines (pixels),
in the median."""
OUTSIDE = 100.0
"""-2 log evidence against a repair that brings all points out of the depth range; a share of them has its
share of it."""
BARREL, PINCUSHION = -0.6, 0.4
"""Bounds of k1 times the squared radius of the farthest corner, at z = 1."""


@dataclass(frozen=True)
class Diagnosis:
    """Result of a diagnosis.

    Attributes:
        named: the mistake with its repaired rig; of kind "nothing", with the given rig, if none explains the
            images clearly better than a drift of the cameras. Where images are not of the rig's sizes, the
            best of the mistakes that explain the sizes, however well it fits (`after`).
        equal: mistakes that explain the images as well, or as well as a drift if none is named: the best of
            each kind, and of the named kind one whose rig is another.
        before: statistics of the given rig.
        after: statistics of the rig of `named`.
        tried: statistics of the hypotheses, the least `penalised_misfit` first; without the given rig where
            images are not of its sizes.
        matches: number of points used, of all pairs.
        healthy: True if the given rig fits the images; False if they are not of its sizes.
        certain: True if a mistake is named, and all explanations as good lead to the same rig.
        depth: depth bounds (near, far) of the points by the named rig, in its unit; None if that rig states a
            depth range or too few points have depth.
        beyond: number of points left out because they lie beyond the range of a lens model of the given rig.
        undetermined: sentences on pairs whose points determine no lines.
    """

    named: Hypothesis
    equal: tuple[Hypothesis, ...]
    before: FitStatistics
    after: FitStatistics
    tried: Mapping[Hypothesis, FitStatistics]
    matches: int
    healthy: bool
    certain: bool
    depth: tuple[float, float] | None = None
    beyond: int = 0
    undetermined: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """The diagnosis as a sentence or two, without a full stop at the end."""
        others = "; or: ".join(hypothesis.words for hypothesis in self.equal)
        if self.named.kind != "nothing":
            return f"likely mistake: {self.named.words}" + (f"; or: {others}" if others else "")
        if self.healthy and self.before.misfit < HEALTHY_MISFIT:
            return "nothing wrong: the points lie on their lines to the accuracy of their positions"
        if self.healthy:
            return (
                f"healthy: none of the usual mistakes, and {self.before.misfit:.2f} px off these images, as "
                "factory calibrations are; `pat rig refine` may bring the lines nearer"
            )
        if self.before.misfit < HEALTHY_MISFIT:  # of the rig's own oddities, where lines say nothing
            words = (
                "none of the usual mistakes: the points lie on their lines, but behind the cameras, outside "
                "the depth range or mirrored: check positions, rotations and depth range"
            )
            return "; ".join([words, *self.named.rig.check()])
        return (
            f"none of the usual mistakes, but the rig is {self.before.misfit:.2f} px off these images: "
            "it has drifted or was inaccurate from the beginning; "
            "`pat rig refine` may repair what can be observed"
        ) + (f". As plausible as a drift, but not more: {others}" if others else "")

    def as_text(self) -> str:
        """Return the verdict, statistics (before, and after if a mistake is named), number of points, and
        remarks as text: a line each."""
        unit = length_unit(self.named.rig)
        lines = [self.verdict, f"as given: {self.before.as_text(unit)}"]
        if self.beyond:
            lines.append(
                f"{self.beyond} of {self.beyond + self.matches} points lie where a lens model has ended, "
                "and are left out: `pat rig info` says where, `pat rig convert --refit` fits a lens anew"
            )
        if self.named.kind != "nothing":
            lines.append(f"repaired: {self.after.as_text(unit)}")
        lines += [f"from {self.matches} points seen in two images", *self.undetermined]
        if self.depth is not None:
            near, far = (f"{bound:.3g}" for bound in self.depth)
            lines.append(
                f"the rig states no depth range; the points are {near} to {far} {unit} away, with a margin: "
                f"add `depth: [{near}, {far}]` to its file, or give `--depth {near} {far}` where it is used"
            )
        return "\n".join(lines)

    def as_json(self) -> str:
        """Return the diagnosis as an indented JSON object.

        Its keys: `verdict`; `mistake` and `words`, those of the named hypothesis; `as_good` (`equal`, each
        with `mistake` and `words`); `healthy`, `matches`, `beyond_lenses`, `undetermined`, `depth`; `before`
        and `after`, with the names of `FitStatistics`; and `tried`, a list of the ten best hypotheses with
        these, `kind` and `words`. Statistics have four digits after the point, and null for NaN.
        """
        tried = [{"kind": h.kind, "words": h.words, **_rounded(f)} for h, f in self.tried.items()][:10]
        document = {
            "verdict": self.verdict,
            "mistake": self.named.kind,
            "words": self.named.words,
            "as_good": [{"mistake": h.kind, "words": h.words} for h in self.equal],
            "healthy": self.healthy,
            "matches": self.matches,
            "beyond_lenses": self.beyond,
            "undetermined": self.undetermined,
            "depth": self.depth,
            "before": _rounded(self.before),
            "after": _rounded(self.after),
            "tried": tried,
        }
        return json.dumps(document, indent=2)


def _rounded(fit: FitStatistics) -> dict[str, float | None]:
    return {name: None if math.isnan(value) else round(value, 4) for name, value in fit._asdict().items()}


@torch_in_one_thread()
def diagnose(rig: Rig, images: Images, matches: Pairs | None = None) -> Diagnosis:
    """Find the usual mistake, if any, in a rig, by one image of each of two or more of its cameras.

    Args:
        rig: rig of two cameras or more, not a batch.
        images: one image (C, H, W) in 0..1 per camera, by name; any size.
        matches: matched points by pair of cameras, used instead of matching the images; None to match them.

    Returns:
        The mistake with its repaired rig, and what else was compared.

    Raises:
        ValueError: in one line, for a camera that the rig lacks, images that `match_cameras` refuses, given
            points of which too few agree, or a rig that relates none of the matched cameras by lines.
    """
    for name in images:
        rig.require(name)
    sizes = image_sizes(images)
    return diagnose_matches(rig, sizes, match_cameras(images) if matches is None else agreeing_pairs(matches))


def diagnose_matches(rig: Rig, sizes: Mapping[str, HW], pairs: Pairs) -> Diagnosis:
    """Find the usual mistake, if any, in a rig, by points matched between images of these sizes.

    At most `MOST` points of a pair are used, evenly spaced in their list.

    Args:
        sizes: (height, width) of each camera's image, a tuple, which the rig may state otherwise.
        pairs: matched points by pair of cameras; pairs that the rig does not relate by lines are left out.

    Returns:
        The mistake with its repaired rig, and what else was compared.

    Raises:
        ValueError: for no sizes, a camera that the rig lacks, if it relates none of the pairs by lines, or
            for fewer than `ENOUGH` points in all.
    """
    pairs = {names: _thinned(matches) for names, matches in related(rig, pairs, by_lines=True).items()}
    fits = all(rig[name].hw == hw for name, hw in sizes.items())
    points = sum(len(matches.alpha) for matches in pairs.values())
    if points < ENOUGH:
        raise ValueError(f"{points} matched points: {ENOUGH} or more are needed")
    pairs = within_lenses(rig, pairs) if fits else pairs
    tried = [h for h in hypotheses(rig, sizes) if _relates(h.rig, pairs)]
    if fits:
        tried += [*_ignored_lens(rig, pairs), *_degrees(rig, pairs), *_depth_range(rig, pairs)]
        tried += [*_zoomed(rig, pairs), *_cropped(rig, pairs)]
    LOG.info("trying %d mistakes on %d pairs", len(tried), len(pairs))
    fit, inliers, noise = fit_statistics(tried, pairs)
    misfit = {h: f.penalised_misfit for h, f in fit.items()}
    unchanged = named = tried[0]
    table = sorted(tried if fits else tried[1:], key=lambda h: misfit[h])
    least = misfit[next(h for h in table if not h.approximate)]  # estimated numbers fit a rig's misfit too
    equal, usual = EQUAL[0] * least + EQUAL[1], USUAL_MISFIT * max(map(max, sizes.values()))
    fitting = [h for h in table if misfit[h] <= min(max(equal, usual), 3 * usual)]
    likelier = [h for h in fitting if fits and unlikelihood(h.rig) + MARGIN < unlikelihood(rig)]
    healthy = fits and misfit[unchanged] < HEALTHY_MISFIT and not likelier
    as_good: list[Hypothesis] = []
    if not fits:
        as_good = [h for h in table if misfit[h] <= equal]
        named = min(as_good, key=tried.index)
    elif likelier:
        unlike = {h: _off_sizes(h.rig, pairs) + MARGIN * h.approximate for h in likelier}
        named = next(h for h in tried if unlike.get(h, math.inf) <= min(unlike.values()) + TIE)
        as_good = sorted(likelier, key=lambda h: unlike[h])
    elif not healthy:
        LOG.info("comparing the mistakes that leave least with a drift")
        mirrored = fit[unchanged].handed < 0.5
        named, as_good = _by_evidence(misfit, table, pairs, inliers, noise, mirrored=mirrored)
        healthy = named is unchanged and not as_good and misfit[unchanged] < usual
    others = {h: _same_rig(named.rig, h.rig, pairs) for h in as_good if h is not named}
    others_of_kind = {h.kind: h for h in reversed(others) if h.kind != named.kind or not others[h]}
    return Diagnosis(
        named,
        tuple(others_of_kind.values()),
        before=fit[unchanged],
        after=fit[named],
        tried={h: fit[h] for h in table},
        matches=(points_used := sum(len(matches.alpha) for matches in pairs.values())),
        beyond=points - points_used,
        healthy=healthy,
        certain=named is not unchanged and all(others.values()),
        depth=depth_seen(named.rig, pairs) if named.rig.depth is None else None,
        undetermined=undetermined(named.rig, pairs),
    )


def _by_evidence(
    misfit: Mapping[Hypothesis, float],
    table: Sequence[Hypothesis],
    pairs: Pairs,
    inliers: Bool[Tensor, " n"],
    noise: float,
    *,
    mirrored: bool,
) -> tuple[Hypothesis, list[Hypothesis]]:
    """Choose the mistake that explains points clearly better than a drift, or the given rig; and its equals.

    The choice must hold without each part of the image in turn. No drift mirrors an image; one of a principal
    point does what a small shift of pixels does.
    """
    unchanged = next(iter(misfit))
    limit = LARGEST_REMAINDER[0] * misfit[unchanged]
    candidates = [h for h in table if h is not unchanged and misfit[h] <= limit]
    if not candidates:
        return unchanged, []
    limit = misfit[candidates[0]] / LARGEST_REMAINDER[1] + EQUAL[1]
    candidates = [h for h in candidates if misfit[h] <= limit][:MOST_COMPARED]
    evidence_for = {
        h: DriftEvidence.from_points(h.rig, pairs, inliers, noise, unlikelihood(h.rig))
        for h in (unchanged, *candidates)
    }
    drift = evidence_for.pop(unchanged)
    least = min(evidence.cost for evidence in evidence_for.values())
    costs = {h: evidence.cost + MARGIN * h.approximate for h, evidence in evidence_for.items()}
    best = next(h for h in misfit if costs.get(h, math.inf) <= min(costs.values()) + TIE)
    allowed = max(ROUGHLY if best.approximate else EXPLAINED[0], EXPLAINED[1] * misfit[unchanged])
    parts = image_parts(unchanged.rig, pairs)
    parts_left_out = (inliers & (parts != number) for number in parts.unique().tolist())
    clear = (
        misfit[best] <= allowed
        and evidence_for[best].cost + MARGIN < drift.cost
        and all(evidence_for[best].by(used) + MARGIN < drift.by(used) for used in parts_left_out)
    )
    is_named = mirrored or (clear and (bool(unchanged.rig.links) or best.kind not in SHIFTS))
    bound = MARGIN + (least if is_named else min(least, drift.cost))
    near = EQUAL[0] * misfit[best] + EQUAL[1] if is_named else 0.0
    ranked = sorted(evidence_for, key=lambda h: evidence_for[h].cost)
    as_good = [h for h in ranked if evidence_for[h].cost <= bound or misfit[h] <= near]
    return best if is_named else unchanged, as_good


def _off_sizes(rig: Rig, pairs: Pairs) -> float:
    """Return -2 log probability of a rig by the images' sizes and its depth range, which lines do not see."""
    outside = share_outside(rig, pairs)
    return unlikelihood(rig) + OUTSIDE * (1.0 if math.isnan(outside) else outside)


def _same_rig(rig: Rig, other: Rig, pairs: Pairs) -> bool:
    """Return True if no point distinguishes two rigs: by its depth or, without calibration, by its line."""
    change = relative_change(rig, other, pairs)
    if not math.isnan(change):
        return change < SAME_DEPTH
    off = [line_distances(each, pairs).abs() for each in (rig, other)]
    return bool((off[0] - off[1]).abs().median() < SAME_DISTANCE)


def _relates(rig: Rig, pairs: Pairs) -> bool:
    """Return True if a rig relates all pairs by lines; one with two linked cameras swapped may not."""
    every = (rig.pair(*names) for names in pairs)
    return all(pair.calibrated if pair.link is None else bool(pair.link.F.any()) for pair in every)


def _thinned(matches: PointMatches) -> PointMatches:
    """Select at most `MOST` matches, evenly through the list."""
    step = max(1, -(-len(matches.alpha) // MOST))
    return PointMatches(matches.alpha[::step], matches.beta[::step])


def _ignored_lens(rig: Rig, pairs: Pairs) -> list[Hypothesis]:
    """Search for the distortion that best explains the points, for the cameras that have none, if any."""
    bare = [name for name in cameras_of(rig, pairs) if isinstance(rig[name], Camera)]
    bare = [name for name in bare if rig[name].distortion is None]
    if not bare:
        return []
    corners = [rig[name].rays(coarse_grid(rig[name].hw).reshape(-1, 2))[0][:, :2] for name in bare]
    squared = max(float(rays.norm(dim=-1).max()) for rays in corners) ** 2
    k1 = BARREL / squared, PINCUSHION / squared
    return [_searched(partial(ignored_lens, rig, bare), k1, (0.0, 1 / squared), pairs)[0]]


def _searched(
    make: Callable[[float], Hypothesis], bounds: tuple[float, float], prior: tuple[float, float], pairs: Pairs
) -> tuple[Hypothesis, float]:
    """Search for the number (in `bounds`; `prior`: mean, deviation) with points nearest their lines."""
    (low, high), (mean, deviation) = bounds, prior
    for _ in range(ROUNDS):
        numbers = torch.linspace(low, high, 25, dtype=torch.float64)
        off = observations([make(number).rig for number in numbers.tolist()], pairs).off
        off = off.abs().median(1).values + UNLIKELY * ((numbers - mean) / deviation).square()
        best, step = float(numbers[off.argmin()]), (high - low) / 24
        low, high = best - step, best + step
    return make(best), best


def _zoomed(rig: Rig, pairs: Pairs) -> list[Hypothesis]:
    """Search for the focal lengths that fit best: of one camera, or of all with ones too short for pixels."""
    names = [name for name in cameras_of(rig, pairs) if isinstance(rig[name], Camera)]
    short = [name for name in names if is_short(rig[name])]
    zooms = []
    for group in [short] if short else [[name] for name in names]:
        share = focal_length_of(rig[group[0]]) / max(rig[group[0]].hw)
        low, high, middle = (math.log(s / share) for s in (*FOCAL_SHARES, FOCAL_SHARE))
        make = partial(lambda group, zoom: zoomed(rig, group, math.exp(zoom)), group)
        found, zoom = _searched(make, (low, high), (middle, FOCAL_SPREAD), pairs)
        if abs(zoom) > LARGEST_CHANGE * SIGMA["focal"]:
            zooms.append(found)
    return zooms


def _cropped(rig: Rig, pairs: Pairs) -> Iterator[Hypothesis]:
    """Fit principal points, of one camera or of all, if the rig has them far off the middle."""
    odd = [name for name in cameras_of(rig, pairs) if may_be_cropped(rig, name)]
    for group in [*([odd] if len(odd) > 1 else []), *([name] for name in odd)]:
        middle = centred(rig, group)
        sigma = {"centre": OFF_CENTRE * max(rig[group[0]].hw)}
        parameters = free_parameters(
            middle, cameras_of(rig, pairs), free=[f"{name}.centre" for name in group], sigma=sigma
        )
        after = partial(apply_change, middle, parameters)
        z = torch.zeros(sum(len(u.sigma) for u in parameters), dtype=torch.float64)
        z = most_probable(
            lambda z, after=after: sampson_of_pairs(after(z), pairs), z, torch.eye(len(z)).to(z)
        )
        repaired = after(z)
        if not any(may_be_cropped(repaired, name) for name in group):
            yield cropped(repaired, group)


def _degrees(rig: Rig, pairs: Pairs) -> list[Hypothesis]:
    """Search for the lost whole turns of rotation vectors in degrees that were taken for radians.

    No hypothesis where a drift may have turned the cameras as far, or cameras are not calibrated.
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
    missing = {first: TURNS[best]} | {other: TURNS[int(i[best])] for other, i in turns.items()}
    degrees = in_degrees(rig, missing)
    before, after = ([r.pair(first, other).beta_from_alpha.R for other in others] for r in (rig, degrees.rig))
    angles = [float(rotation_vector(R.mT @ Q).norm()) for R, Q in zip(before, after)]
    return [degrees] if max(angles) > 3 * SCALES[-1] * SIGMA["rotation"] else []


def _off_planes(rig: Rig, names: tuple[str, str], matches: PointMatches) -> Float[Tensor, "k k"]:
    """Compute median sines of beta's rays with their epipolar planes, for turns of alpha (rows) and beta."""
    alpha, beta = rig.pair(*names).cameras
    rays = [normalize(camera.rays(points)[0], dim=-1) for camera, points in zip((alpha, beta), matches)]
    of_alpha, of_beta = (from_degrees(camera.R, torch.tensor(TURNS)) for camera in (alpha, beta))
    R = of_beta @ of_alpha[:, None].mT
    t = beta.t - R @ alpha.t
    normals = torch.linalg.cross(t[..., None, :].expand(*R.shape[:2], len(rays[0]), 3), rays[0] @ R.mT)
    sines = (normalize(normals, dim=-1) * rays[1]).sum(-1).abs()
    return sines.nan_to_num(1.0).median(-1).values


def _depth_range(rig: Rig, pairs: Pairs) -> list[Hypothesis]:
    """Return the hypothesis that the rig's depth range is wrong, with the points' range instead."""
    if rig.depth is None or (bounds := depth_seen(rig, pairs)) is None:
        return []
    (near, far), unit = bounds, length_unit(rig)
    words = (
        f"the depth range excludes the scene, which is {near:.3g} to {far:.3g} {unit} away: "
        "correct `depth` in the file"
    )
    return [Hypothesis("depth range", words, rig.replace(depth=bounds))]
