"""Effect of `pat rig refine` on depth if a rig has drifted: simulated rigs, real pairs with published ones.

    python -m tests.benchmarks.bench_drift --draws 3 --out tests/benchmarks/RESULTS_drift.md

Depth is the median relative error of the matched points' depth, against that of the true (simulated) or
published (real) rig, of the drifted rig and of the refined one. *1 px* is the relative depth that one pixel
of disparity is worth (median): published rigs are 0.5 to 1.2 px off their images, so that their depth is good
to about as much. *said* is the change of depth that refine prints, *suggested* the one that the lines alone
suggest. *+* before the distance from the lines: the result was accepted. Lens mistakes are made with the real
pairs' both cameras: their distortion left out, or k1 off.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch

from arraygeom import Distortion, Rig
from calib.images.depth_change import observed_depths
from calib.images.hypotheses import swap
from calib.images.matches import match_cameras
from calib.images.refinement import refine_matches
from pat.app.cli.parser import script
from pat.lab.evaluation.tables import markdown_row
from tests.benchmarks.printed import DATA, head, print_tables, reproducible
from tests.calib.real import RealPair, bumblebee, syntim
from tests.calib.simulated import simulated_matches, simulated_rig

REAL = ("Serfaty", "BatInria", "Color", "Poly", "Money", "SmRub", "BalMouss", "TableSTV")
DRIFTS = (
    *("nothing", "focal +2 %", "rotation .1", "rotation .3", "rotation 1", "centre 5 px", "centre 15 px"),
    *("swapped", "focal +1 %", "both centres 10 px"),
)
LENSES = ("lens left out", "k1 +.05", "k1 +.2", "k1 -.1")


def drifted(rig: Rig, kind: str, g: np.random.Generator) -> Rig:
    """The rig with its second camera (all focal drifts there too) drifted in a random direction."""
    name = rig.names[1]
    if kind == "nothing":
        return rig
    if kind == "swapped":
        return swap(rig, *rig.names[:2])
    if kind.startswith("focal"):
        share = float(kind.split()[1]) / 100
        return rig.perturbed({f"{name}.focal": share * rig[name].K[:2, :2].diagonal()})
    if kind.startswith("both"):
        direction = g.normal(size=2)
        shift = torch.from_numpy(direction / np.linalg.norm(direction) * float(kind.split()[2]))
        return rig.perturbed({f"{each}.centre": shift for each in rig.names[:2]})
    what, size = kind.split()[:2]
    direction = g.normal(size=3 if what == "rotation" else 2)
    size = math.radians(float(size)) if what == "rotation" else float(size)
    return rig.perturbed({f"{name}.{what}": torch.from_numpy(direction / np.linalg.norm(direction) * size)})


def with_lens_mistake(rig: Rig, kind: str) -> Rig | None:
    """The rig without distortion, or with another k1 for every camera; None if there is none to leave out."""
    if kind == "lens left out":
        bare = {name: camera.replace(distortion=None) for name, camera in rig.cameras.items()}
        return (
            rig.replace(cameras=bare) if any(c.distortion is not None for c in rig.cameras.values()) else None
        )
    some = {
        name: camera.replace(
            distortion=camera.distortion or Distortion("brown-conrady", torch.zeros(5, dtype=torch.float64))
        )
        for name, camera in rig.cameras.items()
    }
    change = torch.tensor([float(kind.split()[1]), 0, 0, 0, 0], dtype=torch.float64)
    return rig.replace(cameras=some).perturbed({f"{name}.distortion": change for name in some})


def error(rig: Rig, truth: Rig, matches: dict) -> float:
    """The median relative error of depth; 1 where a point has none under the rig."""
    true = observed_depths(truth, matches)
    off = (observed_depths(rig, matches) / true - 1).abs().nan_to_num(1.0)
    return float(off[~true.isnan()].median())


class Row(NamedTuple):
    """A line of the table: the error of depth before and after, and True if the refined rig was accepted."""

    line: str
    before: float
    after: float
    accepted: bool


def row(label: str, rig: Rig, bad: Rig, matches: dict, kind: str) -> Row:
    found = refine_matches(bad, [matches])
    before, after = (error(r, rig, matches) for r in (bad, found.rig))
    given, refined = (s.median for s in found.held_out)
    distances = f"{given:.2f}", f"{'+' if found.accepted else ''}{refined:.2f}"
    said = "" if found.depth is None else f"{found.depth.change:.1%}"
    stated = "" if found.depth is None else f"{found.depth.suggested:.1%}"
    why = "; ".join(text.split(":")[0] for text in found.objections)
    cells = (label, kind, *distances, f"{before:.2%}", f"{after:.2%}", said, stated, why)
    return Row(markdown_row(list(cells)), before, after, found.accepted)


def summary(what: str, rows: Sequence[Row]) -> str:
    """Count the accepted rows, and those of them whose depth became worse."""
    worse = [100 * (row.after - row.before) for row in rows if row.accepted]
    return (
        f"\n{what}: {len(worse)} of {len(rows)} accepted, which increases depth's error by "
        f"{max(worse):.1f} points at most, by more than one in {sum(points > 1 for points in worse)} cases, "
        f"and decreases it by more than .3 in {sum(points < -0.3 for points in worse)}."
    )


HEAD = head("rig | drift | px before | px after | depth before | depth after | said | suggested | objections")


def simulated(draws: int) -> Iterator[str]:
    yield HEAD
    rows = []
    for field in ("wide", "narrow"):
        for count in (2, 4):
            for kind in DRIFTS:
                for draw in range(1 if kind in ("nothing", "swapped") else draws):
                    g = np.random.default_rng([draw, count, DRIFTS.index(kind)])
                    rig = simulated_rig(field, count, g)
                    matches = simulated_matches(rig, field, g)
                    rows.append(row(f"{field}, {count} cameras", rig, drifted(rig, kind, g), matches, kind))
                    yield rows[-1].line
    yield summary("Simulated rigs", rows)


def real(data: Path, draws: int) -> Iterator[str]:
    yield HEAD
    rows = [found for pair in pairs(data) for found in _real_pair(pair, draws)]
    yield from (found.line for found in rows)
    yield summary("Real pairs", rows)
    yield summary(
        "Of those, lens mistakes", [found for found in rows if found.line.split(" | ")[1] in LENSES]
    )


def pairs(data: Path) -> Iterator[RealPair]:
    yield from chain(syntim(data, REAL), bumblebee(data, ("chair01", "stones01")))


def _real_pair(pair: RealPair, draws: int) -> Iterator[Row]:
    rig = Rig({name: pair.rig[name] for name in pair.images})
    matches = match_cameras(pair.images)
    shifted = rig.perturbed({f"{rig.names[1]}.centre": torch.tensor([1.0, 0.0], dtype=torch.float64)})
    label = f"{pair.name}, 1 px {error(shifted, rig, matches):.1%}"
    for kind in DRIFTS:
        for draw in range(1 if kind in ("nothing", "swapped") or kind.startswith("focal") else draws):
            g = np.random.default_rng([draw, DRIFTS.index(kind)])
            yield row(label, rig, drifted(rig, kind, g), matches, kind)
    for kind in LENSES:
        if (bad := with_lens_mistake(rig, kind)) is not None:
            yield row(label, rig, bad, matches, kind)


def main(
    data: Path = DATA,
    draws: int = 2,
    only: tuple[Literal["simulated", "real"], ...] = ("simulated", "real"),
    out: Path | None = None,
) -> None:
    """Print the tables."""
    reproducible()
    tables = {"simulated": lambda: simulated(draws), "real": lambda: real(data, draws)}
    print_tables("Depth of drifted rigs after refinement", (tables[name]() for name in only), out)


if __name__ == "__main__":
    script(main)
