"""Points to fit and points to hold out, their distances from their lines, and parts of the image."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from arraygeom import Rig
from arraygeom.pixels import HW

from .matches import Pairs, PointMatches
from .residuals import epipolar_residuals

HELD_OUT = 4
"""One in this many points or frames is held out."""
CELL = 24
"""Points are held out by squares of this many pixels of alpha, so that neighbours are in the same part."""
SIGNIFICANT = 2.0
"""Standard errors by which the distances of held-out points must decrease."""
TRIMMED = 0.85
"""The share of the points, those nearest to their lines, that statistics use."""
PARTS = 3
"""The jackknife leaves out one of so many by so many parts of the image."""


def trimmed_square(distance: Float[Tensor, " n"]) -> float:
    """The mean square of the distances of those points that are nearest to their lines."""
    squares = distance.square().sort().values
    return float(squares[: max(1, int(TRIMMED * len(squares)))].mean())


def nearer(before: Float[Tensor, " n"], after: Float[Tensor, " n"]) -> bool:
    """Whether distances from the lines decreased significantly: a paired test, distances clipped at 5 px."""
    gain = before.abs().clamp(max=5) - after.abs().clamp(max=5)
    return float(gain.mean()) > SIGNIFICANT * float(gain.std()) / len(gain) ** 0.5


def line_distances(rig: Rig, pairs: Pairs) -> Float[Tensor, " n"]:
    """Signed distances in pixels of all points from their lines, in beta."""
    return torch.cat([epipolar_residuals(rig.pair(*n), m).line.detach() for n, m in pairs.items()])


def median_off(rig: Rig, pairs: Pairs) -> float:
    """The median size of these distances, pixels."""
    return float(line_distances(rig, pairs).abs().median())


def split(
    frames: Sequence[Pairs],
) -> tuple[dict[tuple[str, str], PointMatches], dict[tuple[str, str], PointMatches]]:
    """Points to use and points to hold out: whole frames if several, else squares of alpha's image."""
    if len(frames) > 1:
        held_out = max(1, len(frames) // HELD_OUT)
        return _joined(frames[:-held_out]), _joined(frames[-held_out:])
    (pairs,) = frames
    marks = {names: held_out_parts(matches) == 0 for names, matches in pairs.items()}
    return (
        {names: matches.only(~marks[names]) for names, matches in pairs.items()},
        {names: matches.only(marks[names]) for names, matches in pairs.items() if bool(marks[names].any())},
    )


def held_out_parts(matches: PointMatches) -> Int[Tensor, " n"]:
    """Which of `HELD_OUT` parts, each of squares of alpha, a point is in; that of number 0 is held out."""
    column, row = (matches.alpha / CELL).floor().long().unbind(-1)
    return (column + 2 * row) % HELD_OUT


def _joined(frames: Sequence[Pairs]) -> dict[tuple[str, str], PointMatches]:
    names = dict.fromkeys(name for frame in frames for name in frame)
    parts = {name: [frame[name] for frame in frames if name in frame] for name in names}
    return {name: PointMatches(*(torch.cat(side) for side in zip(*found))) for name, found in parts.items()}


def held_out_pixels(error: Tensor) -> Tensor:
    """Held-out pixels of a grid: one square of 4 x 4 in `HELD_OUT`."""
    rows, columns = (torch.arange(n) // 4 for n in error.shape)
    return (columns + 2 * rows[:, None]) % HELD_OUT == 0


def image_parts(rig: Rig, pairs: Pairs) -> Int[Tensor, " n"]:
    """Which of `PARTS` x `PARTS` parts of alpha's image each point is in."""
    return torch.cat([parts_of(rig[alpha].hw, matches.alpha) for (alpha, _), matches in pairs.items()])


def parts_of(hw: HW, points: Float[Tensor, "n 2"]) -> Int[Tensor, " n"]:
    """Which of `PARTS` x `PARTS` parts of an image of this size each point (x, y) is in."""
    h, w = hw
    cell = (points * PARTS / points.new_tensor([w, h])).floor().long().clamp(0, PARTS - 1)
    return cell[:, 0] + PARTS * cell[:, 1]
