"""Worth of learned matching, by kind of rig: it was trained on rectified pairs, beta on the right.

    python -m tests.benchmarks.bench_learned [--out tests/benchmarks/RESULTS_learned.md]

Behind each / without it: semi-global matches with a left-right check (`classical`).
Scenes are photographs as layers, the nearest depth moved by 12 to 60 pixels, beta as sharp as alpha if not
said otherwise; and Middlebury's pairs of the report half, beta reduced 2x, the cameras turned. *All*, *seen*:
alpha's pixels, and those beta sees, whose depth is right to a pixel of beta at alpha's resolution. *ECE*: the
expected calibration error of `Frame.confidence`. *Interval*: depths within `Frame.depth_interval`. *Right*,
*stated*: the share of pixels that are seen and right, and the mean confidence.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Generator, Tensor

from arraygeom import Camera, Pose, Rig, intrinsics, pixel_grid, rotation_from_vector
from experiments.evaluation.certainty import Reliability
from experiments.evaluation.halves import of_half
from pat import fuse
from pat.app.cli.parser import script
from pat.fusion.frame import Frame
from pat.fusion.steps import hw_at_alphas_resolution
from pat.lab.data.pairs import middlebury_pairs
from pat.lab.evaluation.ablation import recorded
from pat.lab.evaluation.protocols import mono_colour_task, rectified_rig
from pat.lab.evaluation.tables import markdown_header, markdown_row
from pat.lab.synthesis.layered import LayeredScenes
from pat.lab.synthesis.photos import PhotoBank
from pat.lab.synthesis.rig_distribution import RigDistribution
from pat.lab.synthesis.rigs import RigBatch, log_uniform, uniform
from pat.media.colour import luminance
from pat.networks.weights import load_weights
from pat.support.metrics import score
from tests.benchmarks.printed import DATA, print_tables, reproducible

HW = 240, 320
SIDES = ("on the right", "above", "on the left", "below")
"""Where beta is by the quarter turns of a rectified pair."""
COLUMNS = ("all", "seen", "interval", "PSNR", "SSIM", "ECE", "right", "stated")
FORMATS = (".1%", ".1%", ".1%", ".2f", ".4f", ".3f", ".1%", ".1%")


class Case(NamedTuple):
    """True colours, depth (NaN: not known) and what a beta sees are alpha's, the rig's first camera."""

    rig: Rig
    images: dict[str, Tensor]
    truth: Tensor
    depth: Tensor
    seen: Tensor


@dataclass(frozen=True)
class Kind:
    """Betas' places in baselines (x right, y down, z forward; the nearest depth moves 12 to 60 pixels), how
    much they converge, degrees by which they are rolled at most, pixels a radian and sizes over alpha's."""

    betas: tuple[tuple[float, float, float], ...] = ((1, 0, 0),)
    toe_in: float = 0.0
    roll: float = 0.0
    focal: float = 1.0
    size: float = 1.0

    def rig(self, g: Generator) -> RigBatch:
        """One at random, the nearest depth 1."""
        draws = [float(log_uniform(bounds, (), g)) for bounds in ((0.9, 1.4), (12.0, 60.0), (2.0, 20.0))]
        f, baseline, far = HW[1] * draws[0], draws[1] / (HW[1] * draws[0]), draws[2]
        roll = math.radians(self.roll) * uniform((-1, 1), (1,), g)
        K, hw = intrinsics(f, HW), (round(HW[0] * self.size), round(HW[1] * self.size))
        cameras = [Camera(K=K, cam_from_world=Pose.identity(), hw=HW)]
        for place in self.betas:
            centre, axis = baseline * K.new_tensor(place), K.new_tensor([0, 0, 2 / (1 + 1 / far)])
            pose = Pose.look_at(centre, torch.lerp(centre + axis, axis, self.toe_in))
            turn = Pose(rotation_from_vector(torch.cat([0 * roll, 0 * roll, roll])), 0 * centre)
            cameras.append(Camera(K=intrinsics(self.focal * f, hw), cam_from_world=turn @ pose, hw=hw))
        batch = [c.replace(K=c.K[None], cam_from_world=Pose(c.R[None], c.t[None])) for c in cameras]
        return RigBatch(batch, K.new_ones(1), K.new_tensor([far]))


KINDS = {
    "beta on the right": Kind(),
    "beta on the left": Kind(((-1, 0, 0),)),
    "beta above": Kind(((0, -1, 0),)),
    "beta right and below": Kind(((0.7, 0.7, 0),)),
    "converging": Kind(toe_in=1.0),
    "beta in front": Kind(((0, 0, 4),)),
    "beta behind": Kind(((0, 0, -4),)),
    "beta wide, half the focal length": Kind(focal=0.5),
    "beta narrow, twice the focal length": Kind(focal=2.0),
    "rolled up to 40 degrees": Kind(roll=40.0),
    "beta at half resolution": Kind(focal=0.5, size=0.5),
    "beta at a quarter": Kind(focal=0.25, size=0.25),
    "four betas, on all sides": Kind(((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0))),
}


def layered(kind: Kind, scenes: LayeredScenes, count: int) -> Iterator[Case]:
    """Photographs as layers of known geometry."""
    for seed in range(count):
        made = scenes.render(kind.rig(g := Generator().manual_seed(seed)), g)
        alpha, *betas = cameras = [camera[0].to(torch.float64) for camera in made.cameras]
        depth, seen = made.depth[0][0], torch.zeros(HW, dtype=torch.bool)
        points = alpha.unproject(pixel_grid(HW, dtype=torch.float64), depth.double())
        for beta, index in zip(betas, made.index[1:]):
            there = beta.project(points)
            on = there.valid & beta.contains(there.x)
            x, y = torch.where(on[..., None], there.x, 0.0).round().long().unbind(-1)
            same = index[0, y.clamp(max=beta.hw[0] - 1), x.clamp(max=beta.hw[1] - 1)] == made.index[0][0]
            seen |= on & same
        names = ["alpha", *(f"beta {i}" for i in range(len(betas)))]
        images = {name: image[0] for name, image in zip(names, made.images)}
        rig = Rig(dict(zip(names, cameras)), depth=(float(depth.min()) / 1.1, float(depth.max()) * 1.1))
        given = recorded({**images, "alpha": luminance(images["alpha"])}, g)
        yield Case(rig, given, images["alpha"], depth, seen)


def turned(folder: Path, k: int) -> Iterator[Case]:
    """Real pairs, beta reduced 2x, the cameras turned so often: beta on the right, above, left, below."""
    for pair in of_half(middlebury_pairs(folder), "report"):
        task = mono_colour_task(pair, rate := 2)
        assert task.disparity is not None
        (h, w), (value, valid) = task.alpha.shape[1:], task.disparity
        rig = rectified_rig((h, w), {"beta": (h // rate, w // rate)}, 1.1 * float(value.max()))
        depth = torch.where(valid, w / value, torch.nan)
        planes = task.alpha, task.beta, task.ground_truth, depth, task.disparity.regions().seen
        alpha, beta, *known = (plane.rot90(k, (-2, -1)) for plane in planes)
        cameras = {name: rig[name].rot90(k) for name in rig.names}
        yield Case(rig.replace(cameras=cameras), {"alpha": alpha, "beta": beta}, *known)


def figures(case: Case, frame: Frame) -> tuple[tuple[float, ...], tuple[Tensor, Tensor]]:
    """The first `COLUMNS` of a frame, and of each pixel the confidence and whether it is right."""
    pair, h, w = case.rig.pair("alpha", case.rig.names[1]), *case.depth.shape
    alpha, beta = pair.cameras
    depths = (d.double().nan_to_num(1.0) for d in (frame.depth, case.depth))
    ours, true = (beta.project(alpha.unproject(pixel_grid((h, w)).double(), d)).x for d in depths)
    known, pixel = case.depth.isfinite(), beta.hw[1] / hw_at_alphas_resolution(pair)[1]
    near = frame.depth.isfinite() & ((ours - true).norm(dim=-1) <= pixel)
    within = (1 / frame.depth - 1 / case.depth).abs() <= frame.half_width
    places = near[known], near[known & case.seen], within[known & frame.depth.isfinite()]
    shares = (float(plane.double().mean()) for plane in places)
    scores = score(frame.image.clamp(0, 1), case.truth)
    return (*shares, *scores), (frame.confidence[known], (near & case.seen)[known])


def over(found: Sequence[tuple[tuple[float, ...], tuple[Tensor, Tensor]]]) -> list[float]:
    """The `COLUMNS` over frames; certainty over the pixels of all."""
    shares, pixels = zip(*found)
    stated, right = map(torch.cat, zip(*pixels))
    error = Reliability.from_samples(stated, right).error
    return [*np.mean(shares, 0).tolist(), error, float(right.double().mean()), float(stated.double().mean())]


def table(data: Path, count: int, turns: tuple[int, ...]) -> Iterator[str]:
    """A row for each kind."""
    network, bare = load_weights("mono-colour"), load_weights("classical")
    scenes = LayeredScenes(PhotoBank.load(data / "photos/city100", max_edge=640), RigDistribution(), hw=HW)
    made = {name: partial(layered, kind, scenes, count) for name, kind in KINDS.items()}
    for k in turns:
        made[f"Middlebury, beta {SIDES[k]}"] = partial(turned, data / "middlebury", k)
    yield markdown_header(["rig", *COLUMNS])
    for name, cases in made.items():
        found = []
        for case in cases():
            given = case.images, case.rig
            frames = (
                fuse(*given, alpha="alpha", network=network),
                fuse(*given, alpha="alpha", network=bare),
            )
            found.append([figures(case, frame) for frame in frames])
        cells = zip(FORMATS, *map(over, zip(*found)))
        yield markdown_row([name, *(f"{a:{form}} / {b:{form}}" for form, a, b in cells)])


def main(
    data: Path = DATA, count: int = 12, turns: tuple[int, ...] = (0, 1), out: Path | None = None
) -> None:
    """Print the table.

    Args:
        data: With photos/city100 and middlebury.
        count: Layered scenes of each kind.
        turns: Quarter turns, each of which Middlebury's pairs are fused after: 0 to 3.
        out: The file to write.
    """
    reproducible()
    print_tables("What is learned of matching, by kind of rig", [table(data, count, turns)], out)


if __name__ == "__main__":
    script(main)
