"""What `pat rig doctor` calls mistakes, drifts and healthy rigs, and what its repair does to depth: a confusion table.

    python -m tests.benchmarks.bench_names --draws 20 --out tests/benchmarks/RESULTS_names.md

Simulated rigs of wide and narrow field, and with --real real pairs and their published rigs; a mistake is made with the
rig. *worse*: a wrong name whose repair has a larger error of depth than the rig had, or lies farther
from the points. The mistakes of images (another size, cropped, rotated) are in `bench_doctor`.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from arraygeom import Camera, Distortion, Pose, Rig
from arraygeom.io.native import write
from calib.images.doctor import Diagnosis, diagnose_matches
from calib.images.matches import match_cameras, seen_depths
from calib.images.remedies import TRANSPOSE, on_cameras, on_pixels, rotated_view, swap
from pat.evaluation.tables import markdown_header, markdown_row
from tests.benchmarks.bench_drift import drifted, error
from tests.benchmarks.printed import print_tables
from tests.calib.real import bumblebee, syntim
from tests.calib.simulated import simulated_matches, simulated_rig

Random = np.random.Generator
DRIFTED = "drifted"
REAL = ("Color", "Poly", "Money", "Serfaty", "BatInria", "SmRub")


class Mistake(NamedTuple):
    """Its name ("nothing" for drifts and healthy rigs), and how it is made; lens: with rigs that have one only."""

    kind: str
    make: Callable[[Rig, Random], Rig]
    lens: bool = False


def on(change: Callable[[Camera], Camera], *, both: bool = True) -> Callable[[Rig, Random], Rig]:
    return lambda rig, g: on_cameras(rig, rig.names if both else [str(g.choice(rig.names))], change)


def shifted(d: float) -> Callable[[Camera], Camera]:
    def change(c: Camera) -> Camera:
        K = c.K.clone()
        K[:2, 2] += d
        return c.replace(K=K)

    return change


def negated(c: Camera) -> Camera:
    assert c.distortion is not None
    return c.replace(distortion=Distortion(c.distortion.model, -c.distortion.coefficients))


def half_size(rig: Rig, g: Random) -> Rig:
    name = str(g.choice(rig.names))
    hw = rig[name].hw
    return rig.with_camera(name, rig.resize(name, (hw[0] // 2, hw[1] // 2))[name].replace(hw=hw))


def mirrored(rig: Rig, g: Random) -> Rig:
    return on_pixels(rig, [str(g.choice(rig.names))], lambda _, view: rotated_view(view, "mirrored left to right"))


def drift(kind: str) -> Callable[[Rig, Random], Rig]:
    return lambda rig, g: drifted(rig, kind, g)


def both_focal(rig: Rig, g: Random) -> Rig:
    return rig.perturbed({f"{n}.focal": 0.02 * rig[n].K[:2, :2].diagonal() for n in rig.names})


MISTAKES = {
    "healthy": Mistake("nothing", lambda rig, g: rig),
    "swapped": Mistake("cameras swapped", lambda rig, g: swap(rig, *rig.names[:2])),
    "inverted": Mistake("pose inverted", on(lambda c: c.replace(cam_from_world=c.cam_from_world.inverse()))),
    "R transposed": Mistake("R transposed", on(lambda c: c.replace(cam_from_world=Pose(c.R.T, c.t)))),
    "sign of t": Mistake("sign of t", on(lambda c: c.replace(cam_from_world=Pose(c.R, -c.t)))),
    "units": Mistake("units", on(lambda c: c.replace(cam_from_world=Pose(c.R, 1000 * c.t)))),
    "1-based, one": Mistake("one-pixel shift", on(shifted(1.0), both=False)),
    "1-based, both": Mistake("one-pixel shift", on(shifted(1.0))),
    "half-size": Mistake("resized", half_size),
    "x/y": Mistake("x and y exchanged", on(lambda c: c.replace(K=TRANSPOSE @ c.K @ TRANSPOSE))),
    "mirrored": Mistake("rotated or mirrored", mirrored),
    "lens sign": Mistake("distortion", on(negated), True),
    "lens ignored": Mistake("distortion", on(lambda c: c.replace(distortion=None)), True),
    "focal of one": Mistake("nothing", drift("focal +2 %")),
    "focal of both": Mistake("nothing", both_focal),
    **{f"rotation {d}": Mistake("nothing", drift(f"rotation {d}")) for d in (".1", ".3", "1", "3")},
    **{f"centre {d} px": Mistake("nothing", drift(f"centre {d} px")) for d in (5, 20)},
}


class Case(NamedTuple):
    """A true rig with its points."""

    rig: Rig
    matches: dict


Outcome = tuple[str, Diagnosis]


class Judge:
    """Outcomes, once for rigs made alike: most mistakes with a real rig are the same in every draw."""

    def __init__(self) -> None:
        self._known: dict[tuple[int, str, str], Outcome] = {}

    def __call__(self, mistake: Mistake, case: Case, bad: Rig) -> Outcome:
        key = id(case), mistake.kind, write(bad)
        if key not in self._known:
            self._known[key] = judged(mistake, case, bad)
        return self._known[key]


def judged(mistake: Mistake, case: Case, bad: Rig) -> Outcome:
    """The outcome: right, drifted, as good (the doctor says so of the true name), wrong, worse, false alarm."""
    sizes = {name: camera.hw for name, camera in case.rig.cameras.items()}
    found = diagnose_matches(bad, sizes, case.matches)
    name = found.named.kind
    if name == "nothing":
        alarm = bad is case.rig and not found.healthy
        return ("drifted" if alarm else "right" if mistake.kind == "nothing" else DRIFTED), found
    if name == mistake.kind:
        return "right", found
    before, after = (error(r, case.rig, case.matches) for r in (bad, found.repaired))
    if bad is case.rig:
        return "false alarm", found
    if after > before + 1e-3 or found.after.misfit > found.before.misfit + 0.05:
        return "worse", found
    return ("as good" if mistake.kind in [r.kind for r in found.equal] else "wrong"), found


def simulated_case(field: str, count: int, g: Random, *, lens: bool) -> Case:
    rig = simulated_rig(field, count, g, lens=lens)
    return Case(rig, simulated_matches(rig, field, g))


def real_cases(data: Path) -> Iterator[tuple[str, Case]]:
    for pair in [*syntim(data, REAL), *bumblebee(data, ("chair01", "stones01"))]:
        rig = Rig({name: pair.rig[name] for name in pair.images})
        matches = match_cameras(pair.images)
        depth = rig.pair(*rig.names)
        yield pair.name, Case(rig.replace(depth=seen_depths(depth, matches[rig.names])), matches)


def table(cases: dict[str, Callable[[Random, bool], Case]], draws: int) -> Iterator[str]:
    columns = ("right", DRIFTED, "as good", "wrong", "worse", "false alarm")
    yield markdown_header(["rig", "made", *columns, "named"])
    totals: Counter[str] = Counter()
    notes, judge = [], Judge()
    for label, make in cases.items():
        for index, (what, mistake) in enumerate(MISTAKES.items()):
            outcomes: Counter[str] = Counter()
            names: Counter[str] = Counter()
            for draw in range(draws):
                g = np.random.default_rng([draw, index])
                case = make(g, mistake.lens)
                if mistake.lens and case.rig[case.rig.names[0]].distortion is None:
                    continue
                outcome, found = judge(mistake, case, mistake.make(case.rig, g))
                outcomes[outcome] += 1
                names[found.named.kind] += 1
                if outcome in ("worse", "wrong", "false alarm"):
                    notes.append(f"{label}, {what}, draw {draw}: {outcome}: {found.verdict}")
            totals += outcomes
            if outcomes:
                spoken = ", ".join(f"{name} {count}" for name, count in names.most_common())
                yield markdown_row([label, what, *(outcomes[c] for c in columns), spoken])
    yield f"\n{dict(totals)} of {sum(totals.values())}\n"
    yield from notes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--cameras", type=int, default=2, help="of the simulated rigs")
    parser.add_argument("--real", action="store_true", help="real pairs instead of simulated rigs")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    cv2.setRNGSeed(0)
    torch.set_num_threads(1)
    if options.real:
        cases = {name: lambda g, lens, case=case: case for name, case in real_cases(options.data)}
    else:
        count = options.cameras
        cases = {
            f"{f}, {count} cameras": lambda g, lens, f=f: simulated_case(f, count, g, lens=lens)
            for f in ("wide", "narrow")
        }
    print_tables("What the doctor names", [table(cases, options.draws)], options.out)


if __name__ == "__main__":
    main()
