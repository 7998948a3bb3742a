"""Names that `pat rig doctor` gives to mistakes, drifts and healthy rigs, with depth after its repair.

    python -m tests.benchmarks.bench_names --draws 20 --out tests/benchmarks/RESULTS_names.md

Simulated rigs of wide and narrow field, and with --real eleven real pairs and their published rigs (--tune:
eleven others); a mistake is made with the rig. Of real pairs only gross mistakes that can be observed count:
points lie farther from their lines by 0.5 px and three times, or most of them behind the cameras or outside
the depth range. *as good*: the right name is one of several that are said to explain the points as well.
*worse*: a wrong name whose repair has a larger error of depth than the rig had, or lies farther from the
points.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from arraygeom import Camera, Distortion, Pose, Rig, rotation_from_vector
from arraygeom.io.native import write
from arraygeom.pose import rotation_vector
from calib.images.depth_change import share_outside
from calib.images.doctor import Diagnosis, diagnose_matches
from calib.images.hypotheses import TRANSPOSE, on_cameras, on_pixels, rotated_view, swap, unlikelihood
from calib.images.matches import match_cameras, seen_depths
from calib.images.residuals import median_off
from pat.app.cli.parser import script
from pat.lab.evaluation.tables import markdown_header, markdown_row
from tests.benchmarks.bench_drift import drifted, error
from tests.benchmarks.printed import DATA, print_tables, reproducible
from tests.calib.real import every_pair
from tests.calib.simulated import simulated_matches, simulated_rig

Random = np.random.Generator
DRIFTED = "drifted"
REAL = (
    *(f"SYNTIM {name}" for name in ("Color", "Serfaty", "BatInria", "TableSTV", "SmRub")),
    *("Bumblebee2 chair01", "Bumblebee2 stones01", "KITTI 03/000000", "Middlebury 2006_third/Cloth1"),
    *("Hilti 0", "Lund 1-3"),
)
TUNE = (
    *(f"SYNTIM {name}" for name in ("Poly", "Billet", "Money")),
    *("Bumblebee2 chair02", "Bumblebee2 thing01", "KITTI object", "Middlebury 2006_third/Midd1"),
    *("Hilti 2", "Lund 4-6", "fox 0001-0009", "fox 0073-0077"),
)
SHIFTS = ("1-based, one", "1-based, both")
"""Too small to be gross, and drifts to the eye."""


class Mistake(NamedTuple):
    """Its name ("nothing": drifts, healthy rigs), and how it is made; lens: with rigs that have one only."""

    kind: str
    make: Callable[[Rig, Random], Rig]
    lens: bool = False


def on(change: Callable[[Camera], Camera], *, both: bool = True) -> Callable[[Rig, Random], Rig]:
    return lambda rig, g: on_cameras(rig, rig.names if both else [str(g.choice(rig.names))], change)


def posed(change: Callable[[Tensor, Tensor], Pose], *, both: bool = True) -> Callable[[Rig, Random], Rig]:
    return on(lambda c: c.replace(cam_from_world=change(c.R, c.t)), both=both)


def turned(R: Tensor, factor: float) -> Tensor:
    return rotation_from_vector(factor * rotation_vector(R))


def reordered(pose: Pose, order: tuple[int, ...]) -> Pose:
    return Pose.from_quaternion(pose.quaternion[list(order)], pose.t)


def shifted(d: float) -> Callable[[Camera], Camera]:
    def change(c: Camera) -> Camera:
        K = c.K.clone()
        K[:2, 2] += d
        return c.replace(K=K)

    return change


def rescaled(focal: float, centre: float) -> Callable[[Camera], Camera]:
    """K with its focal lengths, and its principal point from the corner of the first pixel, times factors."""

    def change(c: Camera) -> Camera:
        K = c.K.clone()
        K[:2, :2] *= focal
        K[:2, 2] = (K[:2, 2] + 0.5) * centre - 0.5
        return c.replace(K=K)

    return change


def cropped(c: Camera) -> Camera:
    """The camera of an image that lost a fifth of its width and height at the left and the top."""
    K = c.K.clone()
    K[:2, 2] += K.new_tensor([0.2 * c.hw[1], 0.2 * c.hw[0]])
    return c.replace(K=K)


def reordered_angles(R: Tensor, t: Tensor) -> Pose:
    angles = Rotation.from_matrix(R.numpy()).as_euler("XYZ")
    return Pose(torch.from_numpy(Rotation.from_euler("ZYX", angles[::-1]).as_matrix()), t)


def left_handed(R: Tensor, t: Tensor) -> Pose:
    S = torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64))
    return Pose(S @ R @ S, S @ t)


def negated(c: Camera) -> Camera:
    assert c.distortion is not None
    return c.replace(distortion=Distortion(c.distortion.model, -c.distortion.coefficients))


def half_size(rig: Rig, g: Random) -> Rig:
    name = str(g.choice(rig.names))
    hw = rig[name].hw
    return rig.with_camera(name, rig.resize(name, (hw[0] // 2, hw[1] // 2))[name].replace(hw=hw))


def mirrored(rig: Rig, g: Random) -> Rig:
    return on_pixels(
        rig, [str(g.choice(rig.names))], lambda _, view: rotated_view(view, "mirrored left to right")
    )


def drift(kind: str) -> Callable[[Rig, Random], Rig]:
    return lambda rig, g: drifted(rig, kind, g)


def both_focal(rig: Rig, g: Random) -> Rig:
    return rig.perturbed({f"{n}.focal": 0.02 * rig[n].K[:2, :2].diagonal() for n in rig.names})


OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))

MISTAKES = {
    "healthy": Mistake("nothing", lambda rig, g: rig),
    "swapped": Mistake("cameras swapped", lambda rig, g: swap(rig, *rig.names[:2])),
    "inverted": Mistake("pose inverted", posed(lambda R, t: Pose(R, t).inverse())),
    "R transposed": Mistake("R transposed", posed(lambda R, t: Pose(R.T, t))),
    "sign of t": Mistake("sign of t", posed(lambda R, t: Pose(R, -t))),
    "units": Mistake("units", posed(lambda R, t: Pose(R, 1000 * t))),
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
    "centre as t": Mistake("centre as t", posed(lambda R, t: Pose(R, -R.T @ t))),
    "OpenGL": Mistake("OpenGL axes", posed(lambda R, t: Pose(OPENGL @ R, OPENGL @ t))),
    "OpenGL, one": Mistake("OpenGL axes", posed(lambda R, t: Pose(OPENGL @ R, OPENGL @ t), both=False)),
    "wxyz as xyzw": Mistake("order of quaternions", posed(lambda R, t: reordered(Pose(R, t), (3, 0, 1, 2)))),
    "xyzw as wxyz": Mistake("order of quaternions", posed(lambda R, t: reordered(Pose(R, t), (1, 2, 3, 0)))),
    "degrees": Mistake("degrees and radians", posed(lambda R, t: Pose(turned(R, 180 / math.pi), t))),
    "radians": Mistake("degrees and radians", posed(lambda R, t: Pose(turned(R, math.pi / 180), t))),
    "K half": Mistake("resized", on(rescaled(0.5, 0.5))),
    "focal half": Mistake("resized", on(rescaled(0.5, 1.0))),
    "centre half": Mistake("resized", on(rescaled(1.0, 0.5))),
    "centre half, one": Mistake("resized", on(rescaled(1.0, 0.5), both=False)),
    "zoomed, one": Mistake("focal length", on(rescaled(1 / 1.3, 1.0), both=False)),
    "cropped, one": Mistake("cropped", on(cropped, both=False)),
    "millimetres": Mistake("focal length", on(rescaled(0.0066, 1.0))),
    "order of angles": Mistake("order of angles", posed(reordered_angles)),
    "frame of t": Mistake("frame of t", posed(lambda R, t: Pose(R, R.T @ t))),
    "NeRF": Mistake("OpenGL axes", posed(lambda R, t: Pose(R, t).inverse() @ Pose(OPENGL, 0 * t))),
    "left-handed": Mistake("left-handed", posed(left_handed)),
    "x of t": Mistake("sign of t", posed(lambda R, t: Pose(R, t * t.new_tensor([-1.0, 1.0, 1.0])))),
    "depth range": Mistake(
        "depth range", lambda rig, g: rig.replace(depth=tuple(6 * float(d) for d in rig.depth))
    ),
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


def observable(case: Case, bad: Rig) -> bool:
    """Return True if images can show a rig's gross mistake: more than its own misfit, points where none is,
    or a principal point or focal length that no image of that size has."""
    if unlikelihood(bad) > unlikelihood(case.rig) + 16:
        return True
    given, wrong = (median_off(rig, case.matches) for rig in (case.rig, bad))
    return wrong > max(given + 0.5, 3 * given) or share_outside(bad, case.matches) > 0.5


def judged(mistake: Mistake, case: Case, bad: Rig) -> Outcome:
    """Outcome: right, drifted, as good (the doctor says so of the true name), wrong, worse, false alarm."""
    sizes = {name: camera.hw for name, camera in case.rig.cameras.items()}
    found = diagnose_matches(bad, sizes, case.matches)
    name = found.named.kind
    if name == "nothing":
        alarm = bad is case.rig and not found.healthy
        return ("drifted" if alarm else "right" if mistake.kind == "nothing" else DRIFTED), found
    if name == mistake.kind:
        return "right", found
    before, after = (error(r, case.rig, case.matches) for r in (bad, found.named.rig))
    if bad is case.rig:
        return "false alarm", found
    if mistake.kind in [r.kind for r in found.equal]:
        return "as good", found
    return (
        "worse" if after > before + 1e-3 or found.after.misfit > found.before.misfit + 0.05 else "wrong"
    ), found


def simulated_case(field: str, count: int, g: Random, *, lens: bool) -> Case:
    rig = simulated_rig(field, count, g, lens=lens)
    return Case(rig, simulated_matches(rig, field, g))


def real_cases(data: Path, names: Sequence[str]) -> Iterator[tuple[str, Case]]:
    for pair in every_pair(data):
        if pair.name in names:
            rig = Rig({name: pair.rig[name] for name in pair.images})
            matches = match_cameras(pair.images)
            yield (
                pair.name,
                Case(rig.replace(depth=seen_depths(rig.pair(*rig.names), matches[rig.names])), matches),
            )


def table(cases: dict[str, Callable[[Random, bool], Case]], draws: int, *, observed: bool) -> Iterator[str]:
    """All cases; `observed`: without mistakes that the images do not show."""
    columns = ("right", DRIFTED, "as good", "wrong", "worse", "false alarm")
    yield markdown_header(["rig", "made", *columns, "named"])
    gross: Counter[tuple[str, str]] = Counter()
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
                bad = mistake.make(case.rig, g)
                gross_mistake = mistake.kind != "nothing" and what not in SHIFTS
                if observed and gross_mistake and not observable(case, bad):
                    continue
                outcome, found = judge(mistake, case, bad)
                outcomes[outcome] += 1
                names[found.named.kind] += 1
                size = "gross" if gross_mistake else "drift" if mistake.kind == "nothing" else "small"
                gross[size, outcome] += 1
                if outcome in ("worse", "wrong", "false alarm"):
                    notes.append(f"{label}, {what}, draw {draw}: {outcome}: {found.verdict}")
            if outcomes:
                spoken = ", ".join(f"{name} {count}" for name, count in names.most_common())
                yield markdown_row([label, what, *(outcomes[c] for c in columns), spoken])
    for what in ("gross", "small", "drift"):
        counts = {outcome: count for (kind, outcome), count in gross.items() if kind == what}
        yield f"\n{what}: {counts} of {sum(counts.values())}\n"
    yield from notes


def main(
    data: Path = DATA,
    draws: int = 20,
    cameras: int = 2,
    real: bool = False,
    tune: bool = False,
    out: Path | None = None,
) -> None:
    """Print the table.

    Args:
        cameras: Of the simulated rigs.
        real: Eleven real pairs instead of simulated rigs.
        tune: Eleven others, by which numbers were chosen.
    """
    reproducible()
    if real or tune:
        pairs = real_cases(data, TUNE if tune else REAL)
        cases = {name: lambda g, lens, case=case: case for name, case in pairs}
    else:
        cases = {
            f"{f}, {cameras} cameras": lambda g, lens, f=f: simulated_case(f, cameras, g, lens=lens)
            for f in ("wide", "narrow")
        }
    print_tables("What the doctor names", [table(cases, draws, observed=real or tune)], out)


if __name__ == "__main__":
    script(main)
