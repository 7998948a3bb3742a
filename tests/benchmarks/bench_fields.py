"""Fields for all pixels of a 1280 x 800 alpha against three betas, beside the pixel-by-pixel construction.

Run as `python -m tests.benchmarks.bench_fields`. Median and range of five runs, float32, two threads. The
baseline is what the paper's own code does for each pixel and beta: the line, the distances of the pixels of a
window about H x, and the 96 nearest, in numpy; timed on a sample of pixels and scaled to all.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

import numpy as np
import torch
import tyro

from arraygeom import (
    Curved,
    Distortion,
    Epipolar,
    EpipolarLine,
    HomographyDisplacement,
    Local,
    NearestVoxels,
    Pair,
    ReceptiveField,
    Rectified,
    Widened,
    pixel_grid,
    sampling_locations,
)
from tests.arraygeom.rigs import PAIRS_HW as HW
from tests.arraygeom.rigs import pairs
from tests.benchmarks.printed import timed

RUNS = 5
SAMPLE = 500


def pixel_by_pixel(pair: Pair, x: np.ndarray, *, count: int = 96, window: int = 80) -> np.ndarray:
    """The nearest pixels of beta for each alpha pixel in turn, (n, count, 2)."""
    F, H = pair.fundamental.numpy(), pair.homography.numpy()
    columns, rows = np.meshgrid(np.arange(HW[1]), np.arange(HW[0]))
    found = np.zeros((len(x), count, 2), dtype=np.int64)
    for i, point in enumerate(x):
        homogeneous = np.array([point[0], point[1], 1.0])
        a, b, c = F @ homogeneous
        cx, cy, scale = H @ homogeneous
        cx, cy = round(cx / scale), round(cy / scale)
        part = np.s_[max(cy - window, 0) : cy + window + 1, max(cx - window, 0) : cx + window + 1]
        u, v = columns[part].ravel(), rows[part].ravel()
        if len(u) < count:
            continue
        nearest = np.argpartition(np.abs(a * u + b * v + c), count - 1)[:count]
        found[i] = np.stack([u[nearest], v[nearest]], -1)
    return found


def main() -> None:
    """Print the table."""
    torch.set_num_threads(2)
    straight = pairs()
    lens = Distortion("brown-conrady", torch.tensor([-0.1, 0.02, 0, 0], dtype=torch.float64))
    curved = pairs(lens)
    g = np.random.default_rng(0)
    sample = torch.from_numpy(g.uniform(0, [HW[1] - 1, HW[0] - 1], (SAMPLE, 2)).round()).float()
    whole = pixel_grid(HW)
    print(
        f"{'field':36} {'pixels':>8} {'median s':>9} {'range s':>15} "
        f"{'s, all pixels':>14} {'us/pixel/beta':>14}"
    )

    def report(name: str, work: Callable[[], object], n: int) -> None:
        (seconds,) = timed(work, repeats=RUNS, clock=time.perf_counter)
        middle, low, high = (f(seconds) for f in (median, min, max))
        every, each = middle * HW[0] * HW[1] / n, middle / (3 * n) * 1e6
        print(f"{name:36} {n:>8} {middle:9.3f} {low:7.3f}-{high:7.3f} {every:14.3f} {each:14.3f}")

    fields: dict[str, tuple[ReceptiveField, list[Pair], torch.Tensor]] = {
        "Epipolar": (Epipolar(), straight, whole),
        "EpipolarLine": (EpipolarLine(), straight, whole),
        "HomographyDisplacement(40)": (HomographyDisplacement(40.0), straight, whole),
        "HomographyDisplacement()": (HomographyDisplacement(), straight, whole),
        "Rectified(40)": (Rectified(40.0), straight, whole),
        "Widened(Epipolar, along=2)": (Widened(Epipolar(), along=2.0), straight, whole),
        "Widened(Epipolar, across=1), sample": (Widened(Epipolar(), across=1.0), straight, sample),
        "Local(5), sample": (Local(5), straight, sample),
        "NearestVoxels(96, 80), sample": (NearestVoxels(), straight, sample),
        "Curved(96), lenses, sample": (Curved(), curved, sample),
    }
    with torch.no_grad():
        for name, (f, chosen, x) in fields.items():
            report(name, lambda: [sampling_locations(f, pair, x) for pair in chosen], x.numel() // 2)  # noqa: B023
    points = sample.numpy()[:200]
    report("pixel by pixel (numpy), sample", lambda: [pixel_by_pixel(p, points) for p in straight], 200)


if __name__ == "__main__":
    tyro.cli(main)
