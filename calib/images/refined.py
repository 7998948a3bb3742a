"""The result of a refinement, and its report as text."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from arraygeom import Rig

from .depth_change import DepthChange
from .lenses import describe_lenses


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
    """Distances of points from their lines: their number and their median, pixels."""

    points: int
    median: float

    def __str__(self) -> str:
        return f"{self.median:.2f} px"


class PhotometricResult(NamedTuple):
    """The photometric error on held-out pixels before and after its minimisation, and whether accepted."""

    before: float
    after: float
    accepted: bool


@dataclass(frozen=True)
class Refinement:
    """The result of a refinement.

    rig: the refined one if `accepted`, else the given one. changes: its differences. unobservable: parameters
    that the images do not determine. held_out: statistics of the points held out, before and after. depth:
    what happens to depth, for calibrated cameras. objections: why the result should not be accepted. kept:
    the parameters of combinations that would change depth without being determined. photometric: the
    photometric error, if it was minimised.
    """

    rig: Rig
    accepted: bool
    changes: tuple[ParameterChange, ...]
    unobservable: tuple[str, ...]
    held_out: tuple[LineStatistics, LineStatistics]
    depth: DepthChange | None = None
    objections: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()
    photometric: PhotometricResult | None = None

    def as_text(self) -> str:
        """The changes, the distances of held-out points and what happens to depth, as text."""
        original, refined = self.held_out
        verdict = "accepted all the same" if self.accepted else "not accepted"
        lines = [
            f"held-out points ({original.points}) lie {original} from their lines before, {refined} after",
            "" if self.depth is None else str(self.depth),
            *(f"{verdict}: {objection}" for objection in self.objections),
            *(f"changed: {change}" for change in self.changes),
            describe_lenses(self.rig) if self.accepted else "the rig is unchanged",
        ]
        if self.unobservable:
            lines.append(f"fixed, as these images do not determine them: {', '.join(self.unobservable)}")
        if self.kept:
            why = "as they would change depth without the images determining it"
            lines.append(f"kept, {why}: combinations of {', '.join(self.kept)}")
        if self.photometric is not None:
            before, after, accepted = self.photometric
            verdict = "accepted" if accepted else "not accepted"
            lines.append(
                f"photometric error on held-out pixels: {before:.4f} before, {after:.4f} after: {verdict}"
            )
        return "\n".join(filter(None, lines))
