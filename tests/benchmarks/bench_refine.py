"""What `pat rig refine` recovers of perturbed rigs: real pairs, the fast + slow array, rendered rigs.

    python -m tests.benchmarks.bench_refine --draws 3 --out tests/benchmarks/RESULTS_refine.md

Every camera is rotated by 0.3 degrees and its principal point moved by 5 px, in random directions. Distances
are medians over held-out points, from their lines, in pixels of beta. *of points* is their distance from the
lines of an F fitted by MAGSAC++ to all points: a lower bound. *of the rig* is the rest, root mean square of
the nearest 85% of the points: their distance without that from this F.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Literal

import cv2
import torch
import tyro
from torch import Tensor

from arraygeom import Link, Rig, View
from arraygeom.pixels import coarse_grid
from calib.images.from_images import rig_from_images
from calib.images.matches import PointMatches, fit_fundamental, line_distance, match_cameras
from calib.images.refinement import FREE, RefinementProblem, polish, refine, refine_matches
from calib.images.residuals import line_distances, split, trimmed_square
from experiments.showcase import FAST, FAST_FRAME, SCENE, SLOW, SLOW_FRAME, published_matrices
from pat.attention import attend_with_statistics
from pat.data.sample_array import load_sample
from pat.evaluation.ablation import AblationCase, rendered_cases
from pat.evaluation.metrics import score
from pat.evaluation.tables import markdown_header, markdown_row
from pat.fusion.fuse import fuse
from pat.media.images import read_image
from pat.networks.weights import load_weights
from tests.benchmarks.printed import DATA, head, print_tables
from tests.calib.real import bumblebee, syntim
from tests.calib.scenes import uninformed

TURN, MOVE = math.radians(0.3), 5.0


def worse(rig: Rig, g: torch.Generator) -> Rig:
    """Every camera rotated by 0.3 degrees, its principal point moved by 5 px."""
    changes = rig.parameters(free=["*.rotation", "*.centre"])
    drawn = {k: torch.randn(v.shape, generator=g, dtype=torch.float64) for k, v in changes.items()}
    return rig.perturbed(
        {k: v / v.norm() * (TURN if k.endswith("rotation") else MOVE) for k, v in drawn.items()}
    )


def median(values: Tensor) -> float:
    return float(values.abs().median())


def real_pairs(data: Path, draws: int, g: torch.Generator) -> Iterator[str]:
    yield head("real pair | points | of points | as published | made worse | refined | of the rig")
    for pair in (
        *syntim(data, ("Serfaty", "BatInria", "Billet", "SmRub", "Money", "Color", "Poly")),
        *bumblebee(data),
    ):
        names = tuple(pair.images)
        rig = Rig({name: pair.rig[name] for name in names})
        matches = match_cameras(pair.images)
        _, held_out = split([matches])
        results = [refine_matches(worse(rig, g), [matches]) for _ in range(draws)]
        before, after = ([r.held_out[i].median for r in results] for i in (0, 1))
        own = own_distances(matches)
        rest = [beyond(line_distances(r.rig, held_out), own) for r in results]
        cells = (pair.name, len(matches[names].alpha), f"{median(own):.2f}")
        published = f"{median(line_distances(rig, held_out)):.2f}"
        yield markdown_row([*cells, published, *map(_span, (before, after, rest))])


def own_distances(pairs: dict) -> Tensor:
    """Of held-out points from the lines of an F fitted to all points."""
    _, held_out = split([pairs])
    (names, points), *_ = pairs.items()
    return line_distance(held_out[names], fit_fundamental(points))


def beyond(found: Tensor, own: Tensor) -> float:
    """The root mean square distance of the nearest points without that of the points themselves."""
    return math.sqrt(max(trimmed_square(found) - trimmed_square(own), 0.0))


def _span(values: list[float]) -> str:
    return f"{min(values):.2f} to {max(values):.2f}"


def fast_and_slow(data: Path) -> Iterator[str]:
    """F as published; as `pat rig refine` and `start` leave it, which find lenses; of the points' own."""
    yield head("fast + slow | points held out | published F | F of all points | refined | started")
    folder = data / "hfr_lfr"
    files = {FAST: folder / SCENE / f"{FAST_FRAME}.png"}
    files |= {name: folder / SCENE / f"{name}_{SLOW_FRAME}.png" for name in SLOW}
    images = {name: read_image(file) for name, file in files.items()}
    published = published_matrices(folder / "fundamental_matrices.json")
    views = {name: View(hw=(int(p.shape[1]), int(p.shape[2]))) for name, p in images.items()}
    rig = Rig(views, links={(FAST, name): Link(F) for name, F in published.items()})
    matches = match_cameras(images)
    _, held_out = split([matches])
    rigs = refine_matches(rig, [matches]).rig, rig_from_images(images).rig
    for names in rig.links:
        points = {names: held_out[names]}
        own = median(own_distances({names: matches[names]}))
        before, *after = (median(line_distances(r, points)) for r in (rig, *rigs))
        medians = (f"{off:.2f}" for off in (before, own, *after))
        yield markdown_row([names[1], len(held_out[names].alpha), *medians])


def rendered_rigs(draws: int, g: torch.Generator, scenes: Path | None) -> Iterator[str]:
    """The sample array and scenes rendered before: rigs, and colours at alpha's view, are the truth."""
    yield head(
        "rendered | draw | true rig | made worse | by points | and by the fusion's error | from images alone"
    )
    network, sample = load_weights("mono-colour"), load_sample()
    found = rendered_cases(scenes) if scenes else ()
    ours = AblationCase("sample array", sample.rig, sample.images, sample.ground_truth, torch.empty(0))
    for case in chain([ours], found):

        def psnr(rig: Rig, case: AblationCase = case) -> float:
            return score(
                fuse(network, rig, case.images, alpha=case.rig.names[0]).image.clamp(0, 1), case.ground_truth
            )[0]

        true, alone = psnr(case.rig), psnr(rig_from_images(case.images).rig)
        for draw in range(1, draws + 1):
            bad = worse(case.rig, g)
            rigs = [bad, *(refine(bad, [case.images], attend=a).rig for a in (None, attend_with_statistics))]
            cells = [f"{p:.2f} dB" for p in (true, *map(psnr, rigs), alone)]
            yield markdown_row([case.name, draw, *cells])


def by_photometry(draws: int, g: torch.Generator) -> Iterator[str]:
    """The fusion's error without any point, from rigs that are four fifths of the way back."""
    yield markdown_header(["sample array", "four fifths back", "by the fusion's error alone"])
    sample = load_sample()
    points = match_cameras(sample.images)
    (names,) = points
    true = exact_points(sample.rig, names)
    for draw in range(1, draws + 1):
        fit = RefinementProblem.of(worse(sample.rig, g), FREE, frames=[points])
        near = uninformed(fit)._replace(z=0.8 * fit.solve().z)
        found, _ = polish(
            fit, near._replace(directions=0.1 * near.directions), [sample.images], attend_with_statistics
        )
        off = [median(line_distances(fit.after(z), {names: true})) for z in (near.z, found.z)]
        yield markdown_row([f"draw {draw}", f"{off[0]:.2f} px", f"{off[1]:.2f} px"])


def exact_points(rig: Rig, names: tuple[str, str]) -> PointMatches:
    """Points without noise, between the depth bounds."""
    alpha, beta = rig.pair(*names).cameras
    x = coarse_grid(alpha.hw).reshape(-1, 2)
    near, far = (float(d) for d in rig.pair(*names).depth_range)
    depth = torch.linspace(near, far, len(x), dtype=torch.float64)[torch.randperm(len(x))]
    y = beta.project(alpha.unproject(x, depth)).x
    seen = beta.contains(y)
    return PointMatches(x[seen], y[seen])


def main(
    data: Path = DATA,
    draws: int = 3,
    only: tuple[Literal["array", "rendered", "photometry", "real"], ...] = (),
    scenes: Path | None = None,
    out: Path | None = None,
) -> None:
    """Print the tables; `scenes` is a folder of scenes rendered by pat render, two cameras each."""
    cv2.setRNGSeed(0)
    g = torch.Generator().manual_seed(0)
    tables = {
        "array": lambda: fast_and_slow(data),
        "rendered": lambda: rendered_rigs(draws, g, scenes),
        "photometry": lambda: by_photometry(draws, g),
        "real": lambda: real_pairs(data, draws, g),
    }
    print_tables("Refinement of rigs", (tables[name]() for name in only or tables), out)


if __name__ == "__main__":
    tyro.cli(main)
