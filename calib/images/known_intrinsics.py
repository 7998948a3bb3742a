"""Positions of cameras of one body with known lenses and roughly known orientations, from one image of each.

The tags of many multispectral cameras state everything but translations. With orientations known, every match
says that one triple product with the baseline is zero: all pairs together give all centres, up to one scale
(Hartley and Zisserman, section 18.5, for known rotations).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from arraygeom import Pose, Rig
from arraygeom.pixels import map_homogeneous
from arraygeom.runtime.text import OPEN, angle

from .explanations import explain
from .guided_matches import guided_matches
from .matches import ENOUGH, Images, PointMatches, near_lines
from .refinement import refine_matches
from .residuals import median_off
from .self_calibration import depth_bounds

WINDOW = 0.09
"""Largest displacement between parallel views, as a share of the longer side: 15 mm at .15 m, 60 degrees."""
NEAR = 4.0
"""Distance in pixels up to which a point is consistent with a baseline: orientations are known to 0.2
degrees."""
SHARE = 0.4
"""Least share of a pair's matches that must agree with a baseline: of wrong ones up to 0.3 do."""
TRIALS = 500
"""Number of directions tried for each baseline (Fischler and Bolles 1981)."""
SIGMA = {"rotation": math.radians(0.5), "translation": 0.3}
"""Standard deviations: of orientations, radians; of translations, as a share of the longest baseline."""
TURNED = 2.0
"""Standard deviations of orientations within which points count as moved by these, not by a baseline."""
ROUNDS = (4.0, 2.0, 2.0)
"""Distances in pixels up to which matches are used, in one refinement after the other."""


def centres_found(
    rig: Rig, images: Images, shown: Mapping[str, Bool[Tensor, "_ _"]], *, alpha: str
) -> tuple[Rig, dict[str, tuple[int, float]]]:
    """Estimate translations of pinhole cameras, and refine their orientations, from one image of each.

    Alpha is at the origin with the world's axes, and the baseline of the first beta has the length that the
    rig states, 1 if that is 0. Cameras that no pairs connect with alpha are left out. Views should be of
    about equal scale and orientation, and parallax a small share of the image (`WINDOW`).

    Args:
        rig: pinhole cameras of known intrinsics and roughly known orientation.
        images: one image (C, H, W) in 0..1 for every camera of the rig, of its size, by name.
        shown: masks (H, W) of the pixels that each camera recorded, by name.
        alpha: name of alpha.

    Returns:
        The rig with its depth range, named `OPEN` if orientations alone explain the points as well; and by
        beta's name the number of its points, in all pairs, and their median distance from their lines,
        pixels.

    Raises:
        ValueError: for an `alpha` that the rig lacks, if no camera matches with it, if points are all in one
            spot, or none have parallax.
        KeyError: for a camera without an image or mask.
    """
    known = rig
    stated = {name: float(rig.pair(alpha, name).beta_from_alpha.t.norm()) for name in rig.betas(alpha)}
    pairs: dict[tuple[str, str], PointMatches] = {}
    for a, b in combinations(rig.names, 2):
        infinite = rig[b].K @ rig[b].R @ rig[a].R.mT @ torch.linalg.inv(rig[a].K)
        window = round(WINDOW * max(images[b].shape[-2:]))
        matches = guided_matches(images[a], images[b], infinite, window=window, shown=(shown[a], shown[b]))
        if (consistent := _consistent(rig, a, b, matches)) is not None:
            pairs[a, b] = consistent
    rig, pairs = _matched(rig, alpha, pairs)
    rig = _with_centres(rig, alpha, pairs)
    for within in ROUNDS:
        pairs = {pair: matches for pair, matches in pairs.items() if {*pair} <= {*rig.names}}
        near = {pair: near_lines(m, rig.pair(*pair).fundamental, within=within) for pair, m in pairs.items()}
        near = {pair: matches for pair, matches in near.items() if len(matches.alpha) >= ENOUGH}
        rig, near = _matched(rig, alpha, near)
        free = [f"{name}.{kind}" for name in rig.betas(alpha) for kind in SIGMA]
        rig = refine_matches(rig, [near], free=free, sigma=SIGMA, keep_depth=False).rig
    first = rig.betas(alpha)[0]
    rig = rig.scaled((stated[first] or 1.0) / float(rig.pair(alpha, first).beta_from_alpha.t.norm()))
    facts = {}
    for name in rig.betas(alpha):
        of_beta = {pair: matches for pair, matches in near.items() if name in pair}
        facts[name] = sum(len(matches.alpha) for matches in of_beta.values()), median_off(rig, of_beta)
    turned = all(_by_turning(known, rig, pair, matches) for pair, matches in near.items())
    return rig.replace(depth=_depths(rig, near), name=OPEN if turned else ""), facts


def _by_turning(known: Rig, rig: Rig, pair: tuple[str, str], matches: PointMatches) -> bool:
    """Return True if no baseline is needed: another orientation, as likely as that known, explains points."""
    explained = explain(matches, rig.pair(*pair))
    a, b = (known[name] for name in pair)
    U, _, Vh = torch.linalg.svd(torch.linalg.inv(b.K) @ explained.H.to(b.K) @ a.K)
    R = U @ Vh * torch.linalg.det(U @ Vh)
    return not explained.has_lines and float(angle(R @ (b.R @ a.R.mT).mT)) < TURNED * SIGMA["rotation"]


def _normals(rig: Rig, a: str, b: str, matches: PointMatches) -> Float[Tensor, "n 3"]:
    """Compute a vector perpendicular to the baseline for each match, in the rig's frame, times the focal
    length.

    Its product with a baseline of length 1 is then about a distance in pixels.
    """
    ray_a, ray_b = _rays(rig, a, b, matches)
    return float(rig[b].K[0, 0]) * torch.linalg.cross(ray_a, ray_b)


def _rays(
    rig: Rig, a: str, b: str, matches: PointMatches
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Compute the matches' rays in the rig's frame, of both cameras."""
    ray_a, ray_b = (
        map_homogeneous(rig[name].R.mT @ torch.linalg.inv(rig[name].K), x.double())
        for name, x in ((a, matches.alpha), (b, matches.beta))
    )
    return ray_a, ray_b


def _consistent(rig: Rig, a: str, b: str, matches: PointMatches) -> PointMatches | None:
    """Select the matches that one direction of the baseline explains; None if few, or a small share."""
    if len(matches.alpha) < ENOUGH:
        return None
    normals = _normals(rig, a, b, matches)
    trial_pairs = torch.randint(len(normals), (TRIALS, 2), generator=torch.Generator().manual_seed(0))
    trials = torch.linalg.cross(normals[trial_pairs[:, 0]], normals[trial_pairs[:, 1]])
    length = trials.norm(dim=-1)
    near = (normals @ (trials / length.clamp(min=1e-12)[:, None]).T).abs() < NEAR
    near &= length > 1e-6  # else the two points say the same
    best = near[:, int(near.sum(0).argmax())]
    enough = int(best.sum()) >= max(ENOUGH, SHARE * len(best))
    return matches.only(best) if enough else None


def _matched(
    rig: Rig, alpha: str, pairs: dict[tuple[str, str], PointMatches]
) -> tuple[Rig, dict[tuple[str, str], PointMatches]]:
    """Select the cameras that pairs connect with alpha, and their pairs. Raises ValueError for none."""
    names = {alpha}
    for _ in pairs:
        names |= {name for pair in pairs if names & set(pair) for name in pair}
    if len(names) < 2:
        raise ValueError(
            "the images hardly match, so their cameras' translations stay unknown: give a rig file"
        )
    rig = Rig({name: rig[name] for name in rig.names if name in names})
    return rig, {pair: matches for pair, matches in pairs.items() if set(pair) <= names}


def _with_centres(rig: Rig, alpha: str, pairs: Mapping[tuple[str, str], PointMatches]) -> Rig:
    """Return the rig with the centres that all matches agree on, alpha's at the origin, most
    points in front."""
    index = {name: i for i, name in enumerate(rig.betas(alpha))}
    rows = []
    for (a, b), matches in pairs.items():
        normals = _normals(rig, a, b, matches)
        row = normals.new_zeros(len(normals), len(index), 3)
        for name, sign in ((b, 1), (a, -1)):
            if name != alpha:
                row[:, index[name]] = sign * normals
        rows.append((row / math.sqrt(len(normals))).flatten(1))
    system = torch.cat(rows)
    weight = system.new_ones(len(system))
    for _ in range(10):  # iteratively reweighted: L1
        _, _, axes = torch.linalg.svd(system * weight[:, None], full_matrices=False)
        off = (system @ axes[-1]).abs()
        weight = (off.median() / off.clamp(min=1e-3 * float(off.median()) + 1e-12)).sqrt()
    centres = {alpha: axes.new_zeros(3), **{name: axes[-1].reshape(-1, 3)[i] for name, i in index.items()}}
    ahead = sum(_points_ahead(rig, pair, matches, centres) for pair, matches in pairs.items())
    side = 1.0 if ahead >= 0 else -1.0
    cameras = {}
    for name, camera in rig.cameras.items():
        R = camera.R.double() @ rig[alpha].R.double().mT
        centre = side * rig[alpha].R.double() @ centres[name]
        cameras[name] = camera.replace(cam_from_world=Pose(R, -R @ centre))
    return Rig(cameras)


def _points_ahead(
    rig: Rig, pair: tuple[str, str], matches: PointMatches, centres: Mapping[str, Tensor]
) -> float:
    """Count how many more matches are in front of both cameras than behind."""
    a, b = pair
    ray_a, ray_b = _rays(rig, a, b, matches)
    baseline = (centres[b] - centres[a]).expand_as(ray_a)
    # a z = baseline + b z2, and so z (a x b) = baseline x b
    return float(
        (torch.linalg.cross(ray_a, ray_b) * torch.linalg.cross(baseline, ray_b)).sum(-1).sign().sum()
    )


def _depths(rig: Rig, near: Mapping[tuple[str, str], PointMatches]) -> tuple[float, float]:
    """Return the range of all pairs' points' depths, extended. Raises ValueError without parallax."""
    every = [depth_bounds(Rig({name: rig[name] for name in pair}), m) for pair, m in near.items()]
    bounded = [bounds for bounds in every if bounds is not None]
    if not bounded:
        raise ValueError("the images have no parallax, so depths stay unknown: give a rig file")
    return min(n for n, _ in bounded), max(f for _, f in bounded)
