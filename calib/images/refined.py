"""The result of a refinement, and its report as text."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from arraygeom import Rig

from .depth_change import DepthChange
from .lenses import describe_lenses


@dataclass(frozen=True)
class ParameterChange:
    """Change of a parameter vector with its posterior standard deviation.

    Attributes:
        name: name of the parameter vector, such as "left.rotation".
        amount: change of each component, in `unit`.
        deviation: posterior standard deviation of each, in `unit`.
        unit: unit for display, such as "degrees"; empty for coefficients of a lens; "F" for the seven degrees
            of freedom of a fundamental matrix.
    """

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
    """Distances of points from their lines.

    Attributes:
        points: number of the points.
        median: median distance, pixels of beta; NaN for no points.
    """

    points: int
    median: float

    def __str__(self) -> str:
        return f"{self.median:.2f} px"


@dataclass(frozen=True)
class Refinement:
    """Result of a refinement.

    Attributes:
        rig: the refined rig if `accepted`, with rough maps for links that had none and have `ENOUGH` points;
            else the given one (from `RefinementProblem.report` the problem's).
        accepted: True if the refined rig is used.
        changes: changes of the observable parameters; empty if not accepted.
        unobservable: names of parameters, or of components ("left.rotation x"), that the images do not
            determine.
        held_out: statistics of the held-out points by the rig before, and by the refined one, accepted or
            not.
        depth: change of depth; None for uncalibrated rigs, too few points of observable depth, or nothing
            observable, and from `refine_matches` with `keep_depth` False.
        objections: reasons not to accept the result, in words; if it was forced, in spite of these.
        undetermined: sentences on pairs whose points determine no lines.
    """

    rig: Rig
    accepted: bool
    changes: tuple[ParameterChange, ...]
    unobservable: tuple[str, ...]
    held_out: tuple[LineStatistics, LineStatistics]
    depth: DepthChange | None = None
    objections: tuple[str, ...] = ()
    undetermined: tuple[str, ...] = ()

    def as_text(self) -> str:
        """Return the distances of held-out points, the change of depth, objections and changes as lines of
        text."""
        original, refined = self.held_out
        verdict = "accepted all the same" if self.accepted else "not accepted"
        lines = [
            f"held-out points ({original.points}) lie {original} from their lines before, {refined} after",
            "" if self.depth is None else f"{'lines mended, ' * self.accepted}{self.depth}",
            *(f"{verdict}: {objection}" for objection in self.objections),
            *(f"changed: {change}" for change in self.changes),
            describe_lenses(self.rig) if self.accepted else "the rig is unchanged",
            *self.undetermined,
        ]
        if self.unobservable:
            lines.append(f"fixed, as these images do not determine them: {', '.join(self.unobservable)}")
        return "\n".join(filter(None, lines))
