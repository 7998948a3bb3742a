"""Residuals of matched points under a rig: epipolar distances, depths, and whether they are in front.

The module also chooses points to fit and to hold out, and the part of the image that each is in. Distances
are in pixels of the distorted images, through any lens, and differentiable in the rig. A batch of rigs (*b)
takes the same points for each, or points (*b, n, 2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from arraygeom import Camera, LensView, Link, Pair, Rig, View, essential_matrix, stack
from arraygeom.pixels import HW, to_homogeneous

from .matches import Pairs, PointMatches, fit_fundamental, line_distance, undistort_matches


class EpipolarResiduals(NamedTuple):
    """Signed epipolar distances in pixels, one per match; without meaning where not `valid`.

    Attributes:
        sampson: distance from the nearest pair of points that fits (Hartley & Zisserman 11.4.3), in both
            images together.
        line: distance from the epipolar line (the curve, through a lens), in beta.
        valid: mask of the matches whose pixels have rays.
    """

    sampson: Float[Tensor, "*b n"]
    line: Float[Tensor, "*b n"]
    valid: Bool[Tensor, "*b n"]


class MatchDepths(NamedTuple):
    """Depth of matched points, one per match.

    Attributes:
        depth: depth in alpha, in the rig's unit (metres), without meaning where not `observable`; NaN for
            pairs known by F (a link), even if they have cameras.
        front: mask of the points in front of both cameras; False for such pairs.
        observable: mask of the points with rays and enough parallax; False for such pairs.
    """

    depth: Float[Tensor, "*b n"]
    front: Bool[Tensor, "*b n"]
    observable: Bool[Tensor, "*b n"]


LEAST_PARALLAX = 2.0
"""Least angle between rays, in pixels, at which their depth is observable."""
FEW = 10
"""Least number of points for a share to be stated."""
HELD_OUT = 4
"""Number of points or frames of which one is held out."""
CELL = 24
"""Side in pixels of alpha's squares by which points are held out, so that neighbours are in the same part."""
SIGNIFICANT = 2.0
"""Standard errors by which the distances of held-out points must decrease."""
TRIMMED = 0.85
"""Share of the points, those nearest to their lines, that statistics use."""
PARTS = 3
"""Number of rows and of columns of parts of the image, one of which the jackknife leaves out."""


def epipolar_residuals(pair: Pair, matches: PointMatches) -> EpipolarResiduals:
    """Compute the signed distances of matches from the epipolar geometry: Sampson's, and that from the line.

    The algebraic error x_beta^T F x_alpha is divided by its gradient in the pixels, which is taken as
    constant. With cameras and no link, rays replace pixels and E replaces F, so that lenses are respected to
    first order in the distance.

    Returns:
        Signed distances in pixels (0 for a link of H alone), differentiable in the rig but not in the points,
        with their validity.

    Raises:
        ValueError: if neither cameras nor F are known.
    """
    return _residuals(pair, matches)[0]


def residuals_and_depths(pair: Pair, matches: PointMatches) -> tuple[EpipolarResiduals, MatchDepths]:
    """Compute the epipolar residuals of matches and, by the same rays, their depths.

    Returns:
        Signed distances in pixels (`epipolar_residuals`), differentiable in the rig; and depths in alpha in
        the rig's unit, detached.

    Raises:
        ValueError: if neither cameras nor F are known.
    """
    residuals, (a, b) = _residuals(pair, matches)
    return residuals, _depths(pair, a.detach(), b.detach(), residuals.valid)


def _residuals(pair: Pair, matches: PointMatches) -> tuple[EpipolarResiduals, tuple[Tensor, Tensor]]:
    alpha, beta = (x.detach().requires_grad_() for x in _for_each(pair, matches))
    with torch.enable_grad():
        (a, b), F, valid = _rays(pair, alpha, beta)
        algebraic = ((b @ F) * a).sum(-1)
        at_alpha, at_beta = torch.autograd.grad(algebraic.sum(), (alpha, beta), retain_graph=True)
    across = at_beta.square().sum(-1)
    both = (across + at_alpha.square().sum(-1)).clamp(min=1e-300)
    line = algebraic / across.clamp(min=1e-300).sqrt()
    return EpipolarResiduals(algebraic / both.sqrt(), line, valid), (a, b)


def within_lenses(rig: Rig, pairs: Pairs) -> dict[tuple[str, str], PointMatches]:
    """Select the matches whose points have rays through their cameras' lens models.

    Returns:
        Matches by pair; all of a pair with fewer than 2 `FEW` such ones.

    Raises:
        ValueError: for a camera that the rig lacks, and pairs with neither cameras nor F.
    """
    kept = {}
    for names, matches in pairs.items():
        valid = epipolar_residuals(rig.pair(*names), matches).valid
        kept[names] = matches.only(valid) if valid.sum() >= 2 * FEW else matches
    return kept


def sampson_of_pairs(rig: Rig, pairs: Pairs) -> list[Float[Tensor, " n"]]:
    """Compute Sampson distances of the points of each pair, pixels; 0 where a pixel has no ray.

    Returns:
        One tensor per pair, signed, differentiable in the rig.

    Raises:
        ValueError: as `within_lenses`.
    """
    parts = [epipolar_residuals(rig.pair(*names), matches) for names, matches in pairs.items()]
    return [torch.where(of_pair.valid, of_pair.sampson, 0.0) for of_pair in parts]


def match_depths(rig: Rig, pairs: Pairs) -> MatchDepths:
    """Compute the depths of all points of all pairs, one at least, where rays are closest to each other.

    Returns:
        Depths in alpha, in the rig's unit, the pairs' points one after the other; differentiable in the rig.

    Raises:
        ValueError: as `within_lenses`.
        TypeError: for no pairs.
    """
    depths = []
    for names, matches in pairs.items():
        pair = rig.pair(*names)
        (a, b), _, valid = _rays(pair, *_for_each(pair, matches))
        depths.append(_depths(pair, a, b, valid))
    return MatchDepths(*(torch.cat(tensors) for tensors in zip(*depths)))


def _depths(pair: Pair, a: Tensor, b: Tensor, valid: Tensor) -> MatchDepths:
    """Compute depths of the points at which two rays are nearest to one another; NaN for pairs known by F."""
    if not pair.calibrated or pair.link is not None:
        never = torch.zeros_like(valid)
        return MatchDepths(torch.full_like(a[..., 2], torch.nan), never, never)
    R, t = pair.beta_from_alpha.R, pair.beta_from_alpha.t[..., None, :]
    rotated = a @ R.transpose(-1, -2)
    aa, bb, ab = (rotated * rotated).sum(-1), (b * b).sum(-1), (rotated * b).sum(-1)
    ta, tb = (rotated * t).sum(-1), (b * t).sum(-1)
    sine2 = aa * bb - ab.square()
    along_a, along_b = (ab * tb - bb * ta) / sine2, (aa * tb - ab * ta) / sine2
    pixel = 1 / pair.cameras[1].K[..., :2, :2].det().abs().sqrt()[..., None]
    observable = valid & (sine2 / (aa * bb) > (LEAST_PARALLAX * pixel).square())
    return MatchDepths(along_a * a[..., 2], (along_a > 0) & (along_b > 0), observable)


def share(chosen: Bool[Tensor, " n"]) -> float:
    """Return the share of points that are chosen; NaN for fewer than `FEW` points."""
    return float(chosen.double().mean()) if len(chosen) >= FEW else math.nan


def systematic_modes(pair: Pair, matches: PointMatches) -> tuple[Float[Tensor, "n m"], Float[Tensor, "n m"]]:
    """Compute derivatives of the Sampson distances by smooth displacements of alpha's points, and of beta's.

    The displacements are what a lens model leaves, about 1 pixel at the image's corner: radial, of third and
    fifth order, and decentred along x and along y.

    Returns:
        Four columns for alpha and four for beta, one row a match, without gradient; 0 where a pixel has no
        ray.

    Raises:
        ValueError: for a pair with neither cameras nor F.
    """
    alpha, beta = (x.detach().requires_grad_() for x in matches)
    with torch.enable_grad():
        (a, b), F, _ = _rays(pair, alpha, beta)
        slopes = torch.autograd.grad(((b @ F) * a).sum(), (alpha, beta))
    norm = torch.cat(slopes, -1).norm(dim=-1).clamp(min=1e-150)
    modes = [
        torch.einsum("ni,nim->nm", slope / norm[:, None], displacements(view.hw, x)).nan_to_num()
        for slope, view, x in zip(slopes, (pair.alpha, pair.beta), matches)
    ]
    return modes[0], modes[1]


def displacements(hw: HW, points: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2 4"]:
    """Compute the smooth displacements of `systematic_modes` at points (x, y) of an image of this size.

    Returns:
        Pixels (x, y) of each of the four displacements, (n, 2, 4).
    """
    h, w = hw
    p = (points - points.new_tensor([(w - 1) / 2, (h - 1) / 2])) / (0.5 * math.hypot(h, w))
    x, y = p.unbind(-1)
    r2 = (p * p).sum(-1, keepdim=True)
    decentred = [
        torch.stack(v, -1) / 3 for v in ((3 * x * x + y * y, 2 * x * y), (2 * x * y, x * x + 3 * y * y))
    ]
    return torch.stack([r2 * p, r2 * r2 * p, *decentred], -1)


def lines_basis(pair: Pair, matches: PointMatches) -> Float[Tensor, "n 8"]:
    """Compute derivatives of the matches' line distances by the eight degrees of freedom of F up to scale.

    For calibrated pairs without a link the matrix is E, between rays.

    Returns:
        Pixels per unit of each degree of freedom, one row a match, without gradient; 0 where a pixel has no
        ray.

    Raises:
        ValueError: for a pair with neither cameras nor F.
        torch.linalg.LinAlgError: for a link of H alone.
    """
    alpha, beta = (x.detach().requires_grad_() for x in matches)
    with torch.enable_grad():
        rays, F, _ = _rays(pair, alpha, beta)
        at_beta = torch.autograd.grad(((rays[1] @ F) * rays[0]).sum(), beta)[0]
    products = (rays[1][:, :, None] * rays[0][:, None, :]).flatten(1).detach()
    columns = (products / at_beta.norm(dim=-1, keepdim=True).clamp(min=1e-150)).nan_to_num()
    size = columns.norm(dim=0).clamp(min=1e-150)
    complement = torch.linalg.svd((F.detach().flatten() * size)[None]).Vh[1:]
    return columns / size @ complement.T


def related(rig: Rig, pairs: Pairs, *, by_lines: bool = False) -> dict[tuple[str, str], PointMatches]:
    """Select the pairs that a rig relates: calibrated ones, and ones with a link.

    Args:
        by_lines: True to leave out links of H alone.

    Returns:
        Matches by pair of names, as given.

    Raises:
        ValueError: if there are none, and for a camera that the rig lacks.
    """

    def relates(pair: Pair) -> bool:
        return pair.calibrated if pair.link is None else not by_lines or bool(pair.link.F.any())

    relations = {names: matches for names, matches in pairs.items() if relates(rig.pair(*names))}
    if not relations:
        raise ValueError(
            "the rig does not relate these cameras: calibrate them, or make a rig with `pat rig start`"
        )
    return relations


def stack_key(pair: Pair) -> tuple[object, ...]:
    """Return what pairs must share to be stacked: calibrated or known by F, and their lens models."""
    lenses = (view.distortion if isinstance(view, LensView) else None for view in (pair.alpha, pair.beta))
    kinds = (None if lens is None else (lens.model, lens.coefficients.shape[-1]) for lens in lenses)
    return (pair.calibrated and pair.link is None, *kinds)


def stacked(pairs: Sequence[Pair]) -> Pair:
    """Stack pairs of one `stack_key` into a batch; image sizes are those of the first."""
    link = None
    if pairs[0].link is not None:
        link = stack([Link(pair.fundamental) for pair in pairs])
    alpha, beta = (_stacked([getattr(pair, side) for pair in pairs]) for side in ("alpha", "beta"))
    return Pair(alpha, beta, None, link)


def _stacked(views: Sequence[View]) -> View:
    with_K = [view for view in views if isinstance(view, LensView)]
    if len(with_K) < len(views):
        return views[0]
    if not all(isinstance(view, Camera) for view in with_K):
        with_K = [LensView(hw=v.hw, sensor=v.sensor, K=v.K, distortion=v.distortion) for v in with_K]
    return stack([view.replace(hw=views[0].hw) for view in with_K])


def _for_each(pair: Pair, matches: PointMatches) -> tuple[Tensor, Tensor]:
    """Expand the points to a batch of rigs."""
    numbers = (
        pair.link.F if pair.link is not None else pair.cameras[0].K if pair.calibrated else pair.fundamental
    )
    x, y = (points.expand(*numbers.shape[:-2], *points.shape[-2:]) for points in matches)
    return x, y


def _rays(pair: Pair, x: Tensor, y: Tensor) -> tuple[tuple[Tensor, Tensor], Tensor, Tensor]:
    """Return rays of the pixels and E, or the undistorted pixels and F; and their validity."""
    if pair.link is not None or not pair.calibrated:
        (a, a_valid), (b, b_valid) = pair.alpha.undistort(x), pair.beta.undistort(y)
        return (to_homogeneous(a), to_homogeneous(b)), pair.fundamental, a_valid & b_valid
    (a, a_valid), (b, b_valid) = (camera.rays(points) for camera, points in zip(pair.cameras, (x, y)))
    return (a, b), essential_matrix(pair.beta_from_alpha), a_valid & b_valid


def own_distance(rig: Rig, pairs: Pairs) -> float:
    """Compute the median distance of points from the lines of an F fitted to each pair: about the least
    possible.

    Returns:
        Distance in undistorted pixels of beta, without pairs that no F fits; 0 if none fits any.

    Raises:
        ValueError: for a camera that the rig lacks.
    """
    distances = []
    for names, matches in pairs.items():
        undistorted = undistort_matches(rig.pair(*names), matches)
        try:
            distances.append(line_distance(undistorted, fit_fundamental(undistorted)))
        except ValueError:
            continue
    return float(torch.cat(distances).median()) if distances else 0.0


def trimmed_square(distance: Float[Tensor, " n"]) -> float:
    """Compute the mean square of the distances of the points, `TRIMMED` of all, nearest to their lines."""
    squares = distance.square().sort().values
    return float(squares[: max(1, int(TRIMMED * len(squares)))].mean())


def nearer(before: Float[Tensor, " n"], after: Float[Tensor, " n"]) -> bool:
    """Return True if distances from the lines fell significantly: a paired test, clipped at 5 px."""
    gain = before.abs().clamp(max=5) - after.abs().clamp(max=5)
    return float(gain.mean()) > SIGNIFICANT * float(gain.std()) / len(gain) ** 0.5


def line_distances(rig: Rig, pairs: Pairs) -> Float[Tensor, " n"]:
    """Compute signed distances of all points of all pairs, one at least, from their lines in beta.

    Returns:
        Distances in beta's pixels, the pairs' points one after the other, detached; without meaning where a
        pixel has no ray.

    Raises:
        ValueError: as `within_lenses`.
    """
    return torch.cat([epipolar_residuals(rig.pair(*n), m).line.detach() for n, m in pairs.items()])


def median_off(rig: Rig, pairs: Pairs) -> float:
    """Compute the median absolute distance of all points from their lines, in beta's pixels.

    Raises:
        ValueError: for pairs with neither cameras nor F.
    """
    return float(line_distances(rig, pairs).abs().median())


def split(
    frames: Sequence[Pairs],
) -> tuple[dict[tuple[str, str], PointMatches], dict[tuple[str, str], PointMatches]]:
    """Split points into those to use and those to hold out: whole frames if several, else squares of alpha's
    image.

    Of several frames the last are held out: one in `HELD_OUT`, rounded down, and at least one.

    Args:
        frames: matched points of each frame, by pair of names; one frame at least.

    Returns:
        Matches to use and to hold out, by pair of names; a pair may lack in either, or have no points to use.

    Raises:
        ValueError: for no frames, and for a single one whose points are all held out, as they are in one
            square.
    """
    if len(frames) > 1:
        held_out = max(1, len(frames) // HELD_OUT)
        return _joined(frames[:-held_out]), _joined(frames[-held_out:])
    (pairs,) = frames
    parts = {names: held_out_parts(matches) for names, matches in pairs.items()}
    marks = {names: fold == fold.unique()[:1] for names, fold in parts.items()}
    if all(bool(mark.all()) for mark in marks.values()):
        raise ValueError(
            "all points seen in two images are in one spot, so that none can be held out: "
            "take images with detail all over"
        )
    return (
        {names: matches.only(~marks[names]) for names, matches in pairs.items()},
        {names: matches.only(marks[names]) for names, matches in pairs.items() if bool(marks[names].any())},
    )


def held_out_parts(matches: PointMatches) -> Int[Tensor, " n"]:
    """Return which of `HELD_OUT` parts, of alpha's squares, a point is in; the first with any is held out."""
    column, row = (matches.alpha / CELL).floor().long().unbind(-1)
    return (column + 2 * row) % HELD_OUT


def _joined(frames: Sequence[Pairs]) -> dict[tuple[str, str], PointMatches]:
    names = dict.fromkeys(name for frame in frames for name in frame)
    parts = {name: [frame[name] for frame in frames if name in frame] for name in names}
    return {
        name: PointMatches(*(torch.cat(side) for side in zip(*matches))) for name, matches in parts.items()
    }


def image_parts(rig: Rig, pairs: Pairs) -> Int[Tensor, " n"]:
    """Return which of `PARTS` x `PARTS` parts of alpha's image each point is in, the pairs one after the
    other."""
    return torch.cat([parts_of(rig[alpha].hw, matches.alpha) for (alpha, _), matches in pairs.items()])


def parts_of(hw: HW, points: Float[Tensor, "n 2"]) -> Int[Tensor, " n"]:
    """Return which of `PARTS` x `PARTS` parts of such an image each point (x, y) is in, row by row."""
    h, w = hw
    cell = (points * PARTS / points.new_tensor([w, h])).floor().long().clamp(0, PARTS - 1)
    return cell[:, 0] + PARTS * cell[:, 1]
