"""A rig from images alone: fundamental matrices and rough maps between cameras that nobody has calibrated."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Rig, View, intrinsics
from arraygeom.pixels import HW

from .lenses import spoken_lenses
from .matches import AGREE, Matches, fit_fundamental, fit_link, line_distance, match_cameras, with_map
from .refine import line_distances, refine_matches, split


class Started(NamedTuple):
    """An uncalibrated rig, and for each of its links how it came about.

    off: median distance of held-out points from their lines, pixels of beta. displacement: pixels of beta to either
    side of the rough map that hold the points. by_focal: whether the rough focal lengths helped.
    """

    rig: Rig
    points: dict[tuple[str, str], int]
    off: dict[tuple[str, str], float]
    displacement: dict[tuple[str, str], float]
    by_focal: dict[tuple[str, str], bool]

    def as_text(self) -> str:
        """One line a link, and one on lenses if there are any."""
        lenses = spoken_lenses(self.rig)
        return "\n".join(
            f"{a} > {b}: {self.points[a, b]} points, held-out ones {self.off[a, b]:.2f} px off their lines, "
            f"seen within {self.displacement[a, b]:.0f} px of the rough map"
            + (", with the focal lengths given" if self.by_focal[a, b] else "")
            for a, b in self.rig.links
        ) + (f"\n{lenses}" if lenses else "")


def start(images: Mapping[str, Float[Tensor, "_ _ _"]], *, focal: Mapping[str, float] | None = None) -> Started:
    """An uncalibrated rig of the cameras that took these images (C, H, W), good enough to fuse with.

    F of every two cameras that see the same, by MAGSAC++ (Barath et al. 2020), and a rough map. With rough focal
    lengths, in pixels, of both cameras an essential matrix is fitted too, of five numbers instead of seven: it is
    taken where it fits points better that were held out. All F are then fitted together, with lenses, and taken on
    the same condition. Raises ValueError, one line: fewer than two images, equal ones, too few points, a focal length
    of no camera.
    """
    focal = dict(focal or {})
    for name, length in focal.items():
        if name not in images or length <= 0:
            raise ValueError(f"--focal: '{name}={length:g}' is no camera with an image, or not positive")
    sizes = {name: (int(p.shape[1]), int(p.shape[2])) for name, p in images.items()}
    found = Started(Rig({name: View(hw=hw) for name, hw in sizes.items()}), {}, {}, {}, {})
    links, matched = {}, match_cameras(images)
    for names, matches in matched.items():
        F, off, by_focal = _fundamental(matches, *(_K(name, focal, sizes) for name in names))
        links[names] = fit_link(matches, F, within=AGREE).link
        found.off[names], found.by_focal[names] = off, by_focal
    rig = found.rig.replace(links=links)
    better = refine_matches(rig, [matched])
    if better.accepted:
        rig = better.rig
        found.off.update(_off(rig, matched))
    for names, matches in matched.items():
        fit = with_map(rig.pair(*names), matches)
        links[names] = fit.link
        found.points[names], found.displacement[names] = len(fit.matches.alpha), fit.displacement
    return found._replace(rig=rig.replace(links=links))


def _off(rig: Rig, matched: Mapping[tuple[str, str], Matches]) -> dict[tuple[str, str], float]:
    _, held_out = split([matched])
    return {names: float(line_distances(rig, {names: m}).abs().median()) for names, m in held_out.items()}


def _K(name: str, focal: Mapping[str, float], sizes: Mapping[str, HW]) -> Tensor | None:
    return intrinsics(focal[name], sizes[name]) if name in focal else None


def _fundamental(matches: Matches, K: Tensor | None, K_beta: Tensor | None) -> tuple[Tensor, float, bool]:
    """F of all points; how far it, fitted to the rest, puts held-out points off; whether it is by focal lengths."""
    (used,), (held_out,) = (list(part.values()) for part in split([{("", ""): matches}]))
    ways: dict[bool, Callable[[Matches], Tensor]] = {False: fit_fundamental}
    if K is not None and K_beta is not None:
        ways[True] = partial(_by_focal, K=K, K_beta=K_beta)
    off = {by: float(line_distance(held_out, fit(used)).median()) for by, fit in ways.items()}
    best = min(off, key=lambda by: off[by])
    return ways[best](matches), off[best], best


def _by_focal(matches: Matches, K: Tensor, K_beta: Tensor) -> Tensor:
    x, y = (points.numpy() for points in matches)
    no_lens = np.zeros(5)
    E, _ = cv2.findEssentialMat(x, y, K.numpy(), no_lens, K_beta.numpy(), no_lens, method=cv2.RANSAC, threshold=1.0)
    if E is None or E.shape != (3, 3):
        return fit_fundamental(matches)
    return torch.linalg.inv(K_beta).T @ torch.from_numpy(E) @ torch.linalg.inv(K)
