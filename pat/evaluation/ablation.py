"""What knowing the rig is worth: one checkpoint, every family of receptive fields, on the same scenes.

The paper's figure of calibrated against rectified as a tool. Scenes are layered photographs seen by unrectified rigs,
alpha with a focal length 1 to 3 times beta's, rendered here; or rendered folders of one's own.
"""

from __future__ import annotations

import csv
import io
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from rich.progress import track
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d

from arraygeom import (
    Camera,
    Dense,
    Epipolar,
    HomographyDisplacement,
    Local,
    NearestVoxels,
    Pair,
    Pose,
    Positions,
    ReceptiveField,
    Rectified,
    Rig,
    Segments,
    apply_homography,
    pixel_grid,
    rotation_from_vector,
)
from arraygeom.atomic import write_text
from arraygeom.fields.straight import covering_displacement
from arraygeom.pixels import HW
from arraygeom.segments import clip_to_image

from ..fusion.fuse import fuse
from ..fusion.results import save_figure
from ..fusion.steps import resolution_ratio
from ..media.colour import luminance
from ..networks.guided import GuidedPAT
from ..networks.protocol import FusionNetwork
from ..sensors import Clip, Coded, Noise, Quantise, record
from ..synthesis.layered import LayeredScenes
from ..synthesis.photos import PhotoBank
from ..synthesis.rendered import RENDER_FILE, Rendered, is_rendered
from ..synthesis.rigs import RigDistribution
from .baseline import classical
from .metrics import bootstrap_interval, score

ALPHA, BETA = "alpha", "beta"
RIGS = RigDistribution(
    mode="general", parallax=(8.0, 60.0), focal_ratio=(1 / 3, 1.0), resolutions=(1.0,), rotation=3.0, decentring=0.05
)
"""Rigs of the layered scenes: beta's focal length is 1/3 to 1 of alpha's, in images of equal sizes."""
DENSE_LIMIT = 2**31
"""Bytes that explicit positions may take; the dense field of larger images is left out."""
RATIOS = (1.0, 1.5, 2.0, 3.0)
"""Groups of focal ratios in the table."""
CROP = 96


class Case(NamedTuple):
    """One scene: the rig, the recorded images, alpha's view in true colour, and its depth in metres."""

    name: str
    rig: Rig
    images: dict[str, Tensor]
    ground_truth: Tensor
    depth: Tensor

    @property
    def ratio(self) -> float:
        """Alpha's focal length over beta's."""
        alpha, beta = self.rig.pair(ALPHA, BETA).cameras
        return float(alpha.K[0, 0] / beta.K[0, 0])


@dataclass(frozen=True)
class Family:
    """A way of choosing where to look: the rig that it believes in, and its field, given how far points can move."""

    field: Callable[[float], ReceptiveField]
    believed: Callable[[Rig, Generator], Rig] = lambda rig, g: rig


@dataclass(frozen=True)
class Row:
    """One family on one scene: the image, and how far off in beta the depth puts alpha's pixels.

    `within_one` is the share of pixels that are within one pixel of beta of where they should be. `note` says why
    there are no figures, where there are none.
    """

    scene: str
    ratio: float
    family: str
    psnr: float = math.nan
    ssim: float = math.nan
    end_point_error: float = math.nan
    within_one: float = math.nan
    note: str = ""


@dataclass(frozen=True)
class Horizontal:
    """The rectified assumption at its best: H is known, place and scale with it, and only the line is taken as a row.

    The run is +-`reach` pixels along x around H x.
    """

    disparity: float

    def __call__(self, pair: Pair, x: Float[Tensor, "*n 2"]) -> Segments:
        """Horizontal segments of beta around H x."""
        centre, placed = apply_homography(pair.homography, x)
        step = centre.new_tensor([self.disparity, 0.0])
        found = clip_to_image(centre + step, centre - step, pair.beta.hw)
        return Segments(found.start, found.end, found.valid & placed)


def families() -> dict[str, Family]:
    """Every family by name, `calibrated` first."""
    exact = {
        "calibrated": Family(lambda disparity: Epipolar()),
        "rectified assumption": Family(lambda disparity: Rectified(2 * disparity, alpha_is="either")),
        "rows around H x": Family(Horizontal),
        "homography + displacement": Family(HomographyDisplacement),
        "nearest voxels": Family(lambda disparity: NearestVoxels()),
        "local 5x5": Family(lambda disparity: Local()),
        "dense": Family(lambda disparity: Dense()),
    }
    turned = {f"turned by {a:g} deg": Family(lambda disparity: Epipolar(), _turned(a)) for a in (0.1, 0.3, 1.0)}
    moved = {f"centre off by {p:g} px": Family(lambda disparity: Epipolar(), _decentred(p)) for p in (1.0, 3.0, 10.0)}
    return exact | turned | moved


def disparity(network: FusionNetwork, pair: Pair) -> float:
    """How far from H x points can be, pixels of beta as the network gets it."""
    scale = resolution_ratio(pair)
    resized = network.equal_resolution and not 0.8 < scale < 1.25
    return max(float(covering_displacement(pair)) / (scale if resized else 1.0), 1.0)


def layered_cases(
    count: int, *, photos: Sequence[Path] = (), hw: HW = (240, 320), rigs: RigDistribution = RIGS, seed: int = 0
) -> Iterator[Case]:
    """Scenes of layered photographs (scikit-image's, if none are given), recorded with some noise."""
    bank = PhotoBank.load(*photos) if photos else sample_photographs()
    scenes, g = LayeredScenes(bank, rigs, hw=hw, seed=seed), Generator().manual_seed(seed)
    for number in range(count):
        made = scenes.sample(1, g)
        ground_truth, seen = (image[0] for image in made.images)
        cameras = {name: _single(camera) for name, camera in zip((ALPHA, BETA), made.cameras)}
        yield _recorded(f"scene {number}", Rig(cameras), ground_truth, seen, made.depth[0][0], g)


def rendered_cases(folder: Path, *, alpha: str | None = None, beta: str | None = None, seed: int = 0) -> Iterator[Case]:
    """Every rendered scene under a folder: `alpha`'s view (the first camera's) with colours from `beta` (the second).

    Raises ValueError for a folder without rendered scenes, or with some that are not whole.
    """
    found = sorted(path.parent for path in folder.rglob("scene.yaml"))
    broken = [path for path in found if not is_rendered(path)]
    if not found or broken:
        what = f"{broken[0]} is not whole ({RENDER_FILE} is missing)" if broken else f"{folder} holds no rendered scene"
        raise ValueError(f"{what}: render it with `pat render`")
    names = (str(path.relative_to(folder)) for path in found)
    return (_rendered_case(n, path, alpha, beta, Generator().manual_seed(seed)) for n, path in zip(names, found))


def _rendered_case(name: str, folder: Path, alpha: str | None, beta: str | None, g: Generator) -> Case:
    scene = Rendered(folder)
    first = scene.rig.require(alpha or scene.rig.names[0])
    second = scene.rig.require(beta or next(n for n in scene.rig.names if n != first))
    frames = [scene.frame(name) for name in (first, second)]
    ground_truth, seen = (record(f.rgb[None], [Clip(), Coded()], g).image[0] for f in frames)
    rig = Rig({ALPHA: scene.rig[first], BETA: scene.rig[second]})
    return _recorded(name, rig, ground_truth, seen, frames[0].depth, g)


def _recorded(name: str, rig: Rig, ground_truth: Tensor, seen: Tensor, depth: Tensor, g: Generator) -> Case:
    """The case of two ideal images: some noise, a depth range a little wider than the scene's."""
    known = depth[depth.isfinite()]
    steps = [Noise(8000, 3), Clip(), Quantise(8)]
    ideal = {ALPHA: luminance(ground_truth), BETA: seen}
    images = {name: record(scene[None], steps, g).image[0] for name, scene in ideal.items()}
    return Case(
        name, rig.replace(depth=(float(known.min()) / 1.1, float(known.max()) * 1.1)), images, ground_truth, depth
    )


def sample_photographs() -> PhotoBank:
    """The photographs that scikit-image ships, and patterns."""
    from ..data.make_sample import photographs
    from ..synthesis.patterns import patterns

    images = photographs()
    return PhotoBank(images + patterns(np.random.default_rng(0), 12), photos=len(images))


def ablate(
    network: FusionNetwork,
    cases: Iterable[Case],
    *,
    out: Path,
    chosen: Mapping[str, Family] | None = None,
    shown: int = 4,
) -> list[Row]:
    """Every family on every case; ablation.md, ablation.csv and ablation.png (crops of `shown` cases) go to `out`."""
    rows: list[Row] = []
    crops: list[Any] = []
    for case in track(cases, "ablating", disable=not sys.stderr.isatty()):
        found, images = _case(network, case, chosen or families())
        rows += found
        if len(crops) < shown:
            crops.append((case, images, {row.family: row.psnr for row in found}))
    write_text(out / "ablation.md", markdown(rows))
    write_csv(out / "ablation.csv", rows)
    save_figure(figure(crops), out / "ablation.png", dpi=80)
    return rows


def _case(network: FusionNetwork, case: Case, chosen: Mapping[str, Family]) -> tuple[list[Row], dict[str, Tensor]]:
    """Rows of a case, and the images of those families that can be served."""
    images = {"alpha alone": case.images[ALPHA].expand(3, -1, -1)}
    notes, errors, far = {}, {}, disparity(network, case.rig.pair(ALPHA, BETA))
    try:
        images["classical"] = classical(case.rig, case.images, ALPHA, BETA)
    except ValueError as error:
        notes["classical"] = str(error)
    for name, family in chosen.items():
        rig = family.believed(case.rig, Generator().manual_seed(crc32(case.name.encode())))
        field = family.field(far)
        notes[name] = cannot(network, field, rig)
        if not notes[name]:
            frame = fuse(network, rig, case.images, alpha=ALPHA, field=field)
            images[name], errors[name] = frame.image.clamp(0, 1), point_errors(case, frame.depth)
    names, none = ["alpha alone", "classical", *chosen], (math.nan, math.nan)
    scores = {name: score(image, case.ground_truth) for name, image in images.items()}
    figures = {name: (*scores.get(name, none), *errors.get(name, none)) for name in names}
    return [Row(case.name, case.ratio, n, *figures[n], notes.get(n, "")) for n in names], images


def point_errors(case: Case, depth: Float[Tensor, "h w"]) -> tuple[float, float]:
    """How far from the true point a depth puts alpha's pixels in beta, where known; the share of all within a pixel.

    Where beta sees the point or not: the true depth says where it is.
    """
    alpha, beta = case.rig.pair(ALPHA, BETA).cameras
    x = pixel_grid(alpha.hw, dtype=torch.float64).reshape(-1, 2)
    ours, theirs = (beta.project(alpha.unproject(x, d.reshape(-1).double())) for d in (depth, case.depth))
    known = theirs.valid & theirs.x.isfinite().all(-1)
    told = known & ours.valid & ours.x.isfinite().all(-1)
    if not told.any():
        return math.nan, math.nan
    error = (ours.x - theirs.x).norm(dim=-1)[told]
    return float(error.mean()), float((error <= 1).sum() / known.sum())


def cannot(network: FusionNetwork, field: ReceptiveField, rig: Rig) -> str:
    """Why a network cannot look where a field says; empty if it can."""
    pair = rig.pair(ALPHA, BETA)
    if isinstance(field, Dense):
        needed = math.prod(pair.alpha.hw) / 4 * math.prod(pair.beta.hw) * 8
        if needed > DENSE_LIMIT:
            return f"does not fit: {needed / 2**30:.0f} GiB of positions"
    if isinstance(network, GuidedPAT) and isinstance(field(pair, torch.zeros(1, 2)), Positions):
        return "explicit positions: GuidedPAT looks along segments"
    return ""


def markdown(rows: Sequence[Row]) -> str:
    """One line a family: mean PSNR with its 95% bootstrap interval, SSIM, dB to calibrated, and by focal ratio."""
    bins = [f"ratio {low:g} to {high:g}" for low, high in pairwise(RATIOS)]
    head = ["family", "PSNR", "SSIM", "against calibrated", *bins, "off, px", "within 1 px", ""]
    names = list(dict.fromkeys(row.family for row in rows))
    lines = [[name, *_cells([row for row in rows if row.family == name], rows)] for name in names]
    table = [head, ["---", *("---:" for _ in head[2:]), "---"], *lines]
    scenes = len({row.scene for row in rows})
    note = (
        f"{scenes} scenes; the focal ratio is alpha's focal length over beta's. PSNR in dB, behind it a 95% interval.\n"
        "The rectified assumption takes lines for rows, and both images for the same field of view; 'rows around\n"
        "H x' is told place and scale, and takes only the lines for rows. Off: how far the depth found puts points in\n"
        "beta.\n\n"
    )
    return note + "".join(f"| {' | '.join(cells)} |\n" for cells in table)


def _cells(rows: Sequence[Row], every: Sequence[Row]) -> list[str]:
    served = [row for row in rows if not math.isnan(row.psnr)]
    if not served:
        return [""] * (len(RATIOS) + 4) + [rows[0].note]
    reference = {row.scene: row.psnr for row in every if row.family == "calibrated"}
    psnr, ssim = [row.psnr for row in served], [row.ssim for row in served]
    low, high = bootstrap_interval(psnr)
    difference = np.mean([row.psnr - reference[row.scene] for row in served]) if reference else math.nan
    groups = [[r.psnr for r in served if a <= r.ratio < b] for a, b in zip(RATIOS, (*RATIOS[1:-1], math.inf))]
    means = [f"{np.mean(g):.2f}" if g else "" for g in groups]
    note = "" if len(served) == len(rows) else f"{len(rows) - len(served)} scenes left out"
    error, within = (np.mean([getattr(row, name) for row in served]) for name in ("end_point_error", "within_one"))
    off = ["", ""] if math.isnan(error) else [f"{error:.2f}", f"{within:.1%}"]
    image = [f"{np.mean(psnr):.2f} ({low:.2f} to {high:.2f})", f"{np.mean(ssim):.4f}", f"{difference:+.2f}"]
    return [*image, *means, *off, note]


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """One line a family and scene; the file appears whole or not at all."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([entry.name for entry in fields(Row)])
    writer.writerows(astuple(row) for row in rows)
    write_text(path, text.getvalue())


def figure(shown: Sequence[tuple[Case, Mapping[str, Tensor], Mapping[str, float]]]) -> Figure:
    """A row of crops for each case, where calibrated and rectified differ most; PSNR of the whole image above."""
    names = list(dict.fromkeys(name for _, images, _ in shown for name in images))
    columns = ["truth", *names]
    drawn = Figure(figsize=(2.2 * len(columns), 2.6 * len(shown)), layout="constrained")
    for i, (case, images, psnr) in enumerate(shown):
        where = _where(images, case.ground_truth)
        for j, name in enumerate(columns):
            axes = drawn.add_subplot(len(shown), len(columns), i * len(columns) + j + 1)
            axes.set_axis_off()
            value = f"\nfocal ratio {case.ratio:.1f}" if name == "truth" else f"\n{psnr.get(name, math.nan):.1f} dB"
            axes.set_title(name + value, fontsize=9)
            image = case.ground_truth if name == "truth" else images.get(name)
            if image is not None:
                axes.imshow(image[(slice(None), *where)].clamp(0, 1).movedim(0, -1).numpy())
    return drawn


def _where(images: Mapping[str, Tensor], ground_truth: Tensor) -> tuple[slice, slice]:
    """The square where the rectified assumption is worse than calibrated by most."""
    h, w = ground_truth.shape[1:]
    side = min(CROP, h, w)
    names = [n for n in ("rectified assumption", "calibrated") if n in images]
    errors = [(images[n] - ground_truth).square().mean(0) for n in names]
    worse = errors[0] - errors[1] if len(errors) == 2 else ground_truth[0] * 0
    lost = avg_pool2d(worse[None, None], side, stride=1)[0, 0]
    top, left = divmod(int(lost.argmax()), lost.shape[1])
    return slice(top, top + side), slice(left, left + side)


def _turned(degrees: float) -> Callable[[Rig, Generator], Rig]:
    """Beta turned about a random axis."""

    def believed(rig: Rig, g: Generator) -> Rig:
        axis = torch.randn(3, generator=g, dtype=torch.float64)
        turn = Pose(rotation_from_vector(axis / axis.norm() * math.radians(degrees)), torch.zeros(3).double())
        beta = _camera(rig)
        return rig.with_camera(BETA, beta.replace(cam_from_world=turn @ beta.cam_from_world))

    return believed


def _decentred(pixels: float) -> Callable[[Rig, Generator], Rig]:
    """Beta's principal point moved in a random direction."""

    def believed(rig: Rig, g: Generator) -> Rig:
        angle = 2 * math.pi * float(torch.rand((), generator=g))
        beta = _camera(rig)
        K = beta.K.clone()
        K[:2, 2] += K.new_tensor([pixels * math.cos(angle), pixels * math.sin(angle)])
        return rig.with_camera(BETA, beta.replace(K=K))

    return believed


def _camera(rig: Rig) -> Camera:
    return rig.pair(ALPHA, BETA).cameras[1]


def _single(camera: Camera) -> Camera:
    """The only camera of a batch of one."""
    pose = Pose(camera.R[0].double(), camera.t[0].double())
    return camera.replace(K=camera.K[0].double(), cam_from_world=pose)
