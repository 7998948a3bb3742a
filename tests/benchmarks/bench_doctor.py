"""How often `pat rig doctor` names the right mistake, over real rigs and images: a table of confusions.

    python -m tests.benchmarks.bench_doctor --data ../shared/data --cases 10 --out
    tests/benchmarks/RESULTS_doctor.md

A case is a real pair and a random mistake made with its rig or its images. One that is no more than the rig's
own misfit is drawn again: where lines move by less than 0.1 px, or by less than 3 times what the rig was off
before, a mistake cannot be distinguished from the drift of a rig. Shifts of a pixel or half of one are drawn
only for rigs that fit their own images to 0.17 px.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import tyro
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom import Camera, Pose, Rig, pixel_grid, sample
from calib.images.doctor import Diagnosis, diagnose_matches
from calib.images.hypotheses import ROTATIONS, TRANSPOSE, on_cameras
from calib.images.matches import match_cameras, seen_depths
from experiments.names import refuse_unknown
from pat.evaluation.tables import markdown_header, markdown_row
from tests.benchmarks.bench_names import negated, shifted
from tests.benchmarks.printed import DATA, print_tables
from tests.calib.real import RealPair, every_pair

Images = dict[str, Tensor]
Random = np.random.Generator
Made = tuple[Rig, Images]
FINE = 0.17
MANY = 60


@dataclass
class Subject:
    """A real pair that is in order, with its matched points and misfit."""

    pair: RealPair
    matches: dict
    misfit: float


def some(names: Sequence[str], g: Random) -> tuple[str, ...]:
    """All cameras or one."""
    return tuple(names) if g.random() < 0.4 else (str(g.choice(names)),)


def nothing(rig: Rig, images: Images, g: Random) -> Made:
    return rig, images


def on_some(change: Callable[[Camera], Camera]) -> Callable[[Rig, Images, Random], Made]:
    return lambda rig, images, g: (on_cameras(rig, some(rig.names, g), change), images)


def shift(pixels: float) -> Callable[[Rig, Images, Random], Made]:
    def make(rig: Rig, images: Images, g: Random) -> Made:
        return on_some(shifted(pixels * g.choice([-1, 1])))(rig, images, g)

    return make


def units(rig: Rig, images: Images, g: Random) -> Made:
    factor = float(g.choice([1e-3, 1e3]))
    return on_cameras(rig, rig.names, lambda c: c.replace(cam_from_world=Pose(c.R, c.t * factor))), images


def swapped(rig: Rig, images: Images, g: Random) -> Made:
    a, b = images
    return rig, {a: images[b], b: images[a]}


def resized(rig: Rig, images: Images, g: Random) -> Made:
    names = some(rig.names, g)
    way = g.integers(3)
    if way == 0:  # K of another size
        factor = float(g.choice([0.5, 2.0, 0.25, 1.5]))
        for name in names:
            h, w = rig[name].hw
            other = rig.resize(name, (round(h * factor), round(w * factor)))
            rig = rig.with_camera(name, other[name].replace(hw=(h, w)))
        return rig, images
    changed = {}
    for name in names:
        h, w = images[name].shape[1:]
        if way == 1:
            hw = (h // 2, w // 2)
            changed[name] = interpolate(images[name][None], hw, mode="area")[0]
        else:
            top, left = h // 16 * 2, w // 16 * 2
            changed[name] = images[name][:, top // 2 : h - top // 2, left // 2 : w - left // 2]
    return rig, images | changed


def rotated(rig: Rig, images: Images, g: Random) -> Made:
    words = str(g.choice(list(ROTATIONS)))
    return rig, images | {name: rotated_image(images[name], words) for name in some(rig.names, g)}


def rotated_image(image: Tensor, words: str) -> Tensor:
    changes: list[Callable[[Tensor], Tensor]] = [
        lambda p: p.flip(-1, -2),
        lambda p: torch.rot90(p, 1, (-2, -1)),
        lambda p: torch.rot90(p, -1, (-2, -1)),
        lambda p: p.flip(-1),
        lambda p: p.flip(-2),
        lambda p: p.mT,
        lambda p: p.flip(-1, -2).mT,
    ]
    return dict(zip(ROTATIONS, changes))[words](image)


def exchanged(rig: Rig, images: Images, g: Random) -> Made:
    names = some(rig.names, g)
    if g.random() < 0.3:
        cameras = {n: rig[n].replace(hw=rig[n].hw[::-1]) for n in names}
        return rig.replace(cameras={**rig.cameras, **cameras}), images
    return on_cameras(rig, names, lambda c: c.replace(K=TRANSPOSE @ c.K @ TRANSPOSE)), images


def lens(rig: Rig, images: Images, g: Random) -> Made:
    way = g.integers(3)
    if way == 0:
        return on_cameras(rig, rig.names, lambda c: c.replace(distortion=None)), images
    if way == 1:
        return on_cameras(rig, rig.names, negated), images
    return rig, {name: undistorted(rig, name, image) for name, image in images.items()}


def undistorted(rig: Rig, name: str, image: Tensor) -> Tensor:
    camera = rig[name]
    straight = camera.replace(distortion=None)
    rays, _ = straight.rays(pixel_grid(camera.hw, dtype=torch.float64))
    where = camera.project_local(rays.reshape(-1, 3)).x.reshape(*camera.hw, 2)
    return sample(image[None], where[None].float()).values[0]


MISTAKES: dict[str, Callable[[Rig, Images, Random], Made]] = {
    "nothing": nothing,
    "resized": resized,
    "rotated or mirrored": rotated,
    "cameras swapped": swapped,
    "pose inverted": on_some(lambda c: c.replace(cam_from_world=c.cam_from_world.inverse())),
    "R transposed": on_some(lambda c: c.replace(cam_from_world=Pose(c.R.T, c.t))),
    "x and y exchanged": exchanged,
    "units": units,
    "distortion": lens,
    "half-pixel shift": shift(0.5),
    "one-pixel shift": shift(1.0),
}


def subjects(data: Path) -> Iterator[Subject]:
    """The real pairs that fit their own images, with the depth range of what both see."""
    for pair in every_pair(data):
        try:
            matches = match_cameras(pair.images)
            names = tuple(pair.images)
            depth = seen_depths(pair.rig.pair(*names), matches[names])
        except ValueError as error:
            print(f"left out: {pair.name}: {error}")
            continue
        cameras = {name: pair.rig[name] for name in names}
        rig = Rig(cameras, depth=depth)
        found = diagnose_matches(rig, {n: c.hw for n, c in cameras.items()}, matches)
        print(f"{pair.name:28s} {found.matches:4d} points, {found.before.as_text()}", flush=True)
        if found.matches >= MANY:
            yield Subject(pair._replace(rig=rig), matches, found.before.penalised_misfit)
        else:
            print(f"left out: {pair.name}: few points")


def case(kind: str, pool: Sequence[Subject], g: Random) -> tuple[str, Diagnosis, int]:
    """A random case: the pair's name, the diagnosis, and how many draws moved no line."""
    fitting = [s for s in pool if kind not in ("half-pixel shift", "one-pixel shift") or s.misfit < FINE]
    if kind == "distortion":
        fitting = [s for s in fitting if any(c.distortion is not None for c in s.pair.rig.cameras.values())]
    for redrawn in range(100):
        subject = fitting[int(g.integers(len(fitting)))]
        rig, images = MISTAKES[kind](subject.pair.rig, subject.pair.images, g)
        sizes = {n: (int(p.shape[1]), int(p.shape[2])) for n, p in images.items()}
        same = all(images[n] is subject.pair.images[n] for n in images)
        matches = subject.matches if same else match_cameras(images)
        found = diagnose_matches(rig, sizes, matches)
        visible = found.before.penalised_misfit > max(subject.misfit + 0.1, 3 * subject.misfit)
        if kind == "nothing" or visible or any(rig[n].hw != sizes[n] for n in sizes):
            return subject.pair.name, found, redrawn
    raise RuntimeError(f"no visible case of '{kind}'")


def confusions(data: Path, cases: int, seed: int, kinds: Sequence[str]) -> Iterator[str]:
    """The table, and every case that was not named alone."""
    yield f"{cases} random cases of each mistake (seed {seed}) with real rigs and their images.\n"
    pool, totals, misses = list(subjects(data)), Counter(), []
    yield markdown_header(["mistake made", "cases", "drawn again", "named"], align="lrrl")
    for kind in kinds:
        g = np.random.default_rng([seed, list(MISTAKES).index(kind)])
        named: Counter[str] = Counter()
        redrawn = 0
        for _ in range(cases):
            name, found, again = case(kind, pool, g)
            redrawn += again
            label = found.named.kind
            equal = label == kind or kind in [r.kind for r in found.equal]
            if label != kind:
                label += " (or the true one)" if equal else ""
                before, after = found.before.as_text(), found.after.as_text()
                misses.append(f"{kind}: {name}: {found.verdict}; before {before}; after {after}")
            totals += Counter({"right": label == kind, "right or equal": equal, "all": 1})
            named[label] += 1
        spoken = ", ".join(f"{label} {count}" for label, count in named.most_common())
        yield markdown_row([kind, cases, redrawn, spoken])
    yield f"\n{dict(totals)}\n"
    yield from misses


def main(
    data: Path = DATA,
    cases: int = 10,
    seed: int = 0,
    only: tuple[str, ...] = tuple(MISTAKES),
    out: Path | None = None,
) -> None:
    """Print the table, of some mistakes or of all."""
    refuse_unknown("--only: no mistake", only, MISTAKES)
    cv2.setRNGSeed(seed)
    print_tables("Which mistakes the doctor names", [confusions(data, cases, seed, only)], out)


if __name__ == "__main__":
    tyro.cli(main)
