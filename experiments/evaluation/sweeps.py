"""The ablation of calibration: the same network and scenes, each field, as one property of the rig changes.

Scenes are layered photographs rendered for each rig, so that the true position of every pixel in beta is
known. What a field is computed from may be another rig than the true one: that is a calibration which is
wrong.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate, pad

from arraygeom import (
    Camera,
    Dense,
    Epipolar,
    Local,
    Pair,
    Pose,
    Positions,
    ReceptiveField,
    Rectified,
    Rig,
    Segments,
    apply_homography,
    intrinsics,
    pixel_grid,
    rotation_from_vector,
    sample,
    stack,
)
from arraygeom.fields.grid import FieldOnGrid
from arraygeom.fields.straight import covering_displacement
from arraygeom.pixels import HW
from experiments.names import refuse_unknown
from pat.attention.scores import peak_position
from pat.fusion.steps import resolution_ratio
from pat.lab.evaluation.ablation import ALPHA, BETA, recorded, sample_photographs, turned
from pat.lab.evaluation.rectified import rectified
from pat.lab.synthesis.layered import LayeredScenes
from pat.lab.synthesis.photos import PhotoBank
from pat.lab.synthesis.rig_distribution import RigDistribution
from pat.lab.synthesis.rigs import RigBatch, in_frame_of
from pat.matching.inputs import Inputs
from pat.media.colour import luminance
from pat.networks.protocol import Comparing
from pat.sensors import generator_for
from pat.support.metrics import score

SIZE: HW = (96, 128)
NEAR, FAR = 2.0, 16.0
"""Depth range of the scenes, metres."""
PARALLAX = 24.0
"""Displacement of the nearest points against infinity, alpha's pixels, where it is not what changes."""
BORDER = 32
"""Pixels by which beta's border is repeated, for all but the search of all of it."""
TILT = 3.0
"""Degrees that beta is rotated by in every rig: none is rectified."""


class Point(NamedTuple):
    """One rig of a sweep: the true one, and the calibration that fields are computed from."""

    sweep: str
    value: float
    rig: Rig
    assumed: Rig


class RecordedScene(NamedTuple):
    """Recorded images by name, alpha's colour view, its pixels' places in beta (h, w, 2), which beta sees."""

    images: dict[str, Tensor]
    ground_truth: Tensor
    position: Float[Tensor, "h w 2"]
    visible: Bool[Tensor, "h w"]


class Result(NamedTuple):
    """The fused image (3, H, W), and where attention is largest in beta as recorded, of each of its bands if
    the network takes them one by one (bands, h, w, 2)."""

    image: Tensor
    peak: Tensor

    def peaks(self, scene: RecordedScene) -> float:
        """The share of pixels beta sees whose largest weight is within a pixel of the true position."""
        off = (self.peak - scene.position).norm(dim=-1)
        return float((off[:, scene.visible] <= 1).double().mean())


class Row(NamedTuple):
    """One field on one scene of one rig.

    `peaks` is the share of the pixels that beta sees whose largest weight is within a pixel of the true
    position. `note` says why there are no figures, where there are none.
    """

    sweep: str
    value: float
    field: str
    scene: int
    psnr: float = math.nan
    ssim: float = math.nan
    peaks: float = math.nan
    seconds: float = math.nan
    note: str = ""


@runtime_checkable
class Way(Protocol):
    """Something other than a field: it is given the network, the calibration and the images."""

    def fuse(self, network: Comparing, rig: Rig, images: Mapping[str, Tensor]) -> Result:
        """The result at alpha's view. Raises ValueError for a rig that it is not for."""
        ...


@dataclass(frozen=True)
class Directly:
    """Images as they are, beta resized to about alpha's angular resolution as `fuse` does, with a field.

    Beta's border is repeated around it, as warped images repeat theirs: what beta does not see is half of the
    error.
    """

    field: ReceptiveField

    def fuse(self, network: Comparing, rig: Rig, images: Mapping[str, Tensor]) -> Result:
        """The network with the pair's field. All of beta is searched as it is: enlarged it would not fit."""
        pair, beta = rig.pair(ALPHA, BETA), images[BETA]
        if isinstance(self.field, Dense):
            return fused(network, pair, images[ALPHA], beta, self.field)
        border = 0 if isinstance(self.field, Rows) else BORDER  # its rows are those of the images as they are
        hw = (pair.beta.hw[0] + 2 * border, pair.beta.hw[1] + 2 * border)
        camera = pair.cameras[1].crop(-border, -border, hw)
        beta = pad(beta[None], (border,) * 4, mode="replicate")
        ratio = resolution_ratio(pair)
        if not 0.8 < ratio < 1.25:
            larger = (round(hw[0] / ratio), round(hw[1] / ratio))
            beta = interpolate(beta, larger, mode="bicubic", align_corners=False, antialias=ratio > 1)
            beta = beta.clamp(0, 1)
            camera = camera.resize(larger)
        result = fused(network, Pair(pair.alpha, camera, pair.depth), images[ALPHA], beta[0], self.field)
        step = result.peak.new_tensor([hw[1] / camera.hw[1], hw[0] / camera.hw[0]])
        return result._replace(peak=(result.peak + 0.5) * step - 0.5 - border)


@dataclass(frozen=True)
class Resampled:
    """Both images warped to rows by the calibration, searched along the rows, and the result warped back."""

    field: ReceptiveField = Epipolar()  # noqa: RUF009 - frozen

    def fuse(self, network: Comparing, rig: Rig, images: Mapping[str, Tensor]) -> Result:
        """Raises ValueError where the pair cannot be rectified, as of a camera ahead of the other."""
        level = rectified(rig, images)
        alpha, beta = (level.images[name] for name in (ALPHA, BETA))
        result = fused(network, level.rectification.pair, alpha, beta, self.field)
        planes = (level.back(one.movedim(-1, 0), interpolation="nearest") for one in result.peak)
        peaks = [plane.movedim(0, -1) for plane in planes]
        there = apply_homography(torch.linalg.inv(level.rectification.H_beta), torch.stack(peaks).double()).x
        return Result(level.back(result.image), there)


@dataclass(frozen=True)
class Rows:
    """The rectified assumption: rows of beta, as far to both sides as the depth range moves points."""

    def __call__(self, pair: Pair, x: Float[Tensor, "*n 2"]) -> Segments | Positions:
        """Horizontal segments through the pixel itself."""
        return Rectified(2 * max(float(covering_displacement(pair)), 1.0), alpha_is="either")(pair, x)


FIELDS: dict[str, ReceptiveField | Way] = {
    "calibrated segments": Epipolar(),
    "rectified, warped": Resampled(),
    "rows": Rows(),
    "local 5x5": Local(),
    "dense": Dense(),
}
"""Fields and ways that are compared by default."""


def ablate(
    network: Comparing,
    rigs: Mapping[str, Rig] | Iterable[Point],
    fields: Mapping[str, ReceptiveField | Way] = FIELDS,
    *,
    scenes: int = 6,
    photos: PhotoBank | None = None,
) -> list[Row]:
    """Each field on so many scenes of each rig; `rigs` by name, or points of sweeps (`points`).

    A rig has two calibrated pinhole cameras, alpha first, and a depth range: its scenes lie in it. `fields`
    are fields, one's own included, or ways. Raises ValueError for another kind of rig.
    """
    points = [Point(name, 0.0, rig, rig) for name, rig in rigs.items()] if isinstance(rigs, Mapping) else rigs
    bank = photos or sample_photographs()
    rows: list[Row] = []
    everywhere: dict[tuple[str, int, bytes], Row] = {}
    for point in points:
        for number in range(scenes):
            scene = made(two(point.rig), bank, number)
            for name, field in fields.items():
                # A search of all of beta asks for no calibration: once for each true rig.
                key = (name, number, _numbers(point.rig))
                row = everywhere.get(key) or _row(network, point, name, field, number, scene)
                if isinstance(field, Dense):
                    everywhere[key] = row
                rows.append(row._replace(sweep=point.sweep, value=point.value))
    return rows


def _numbers(rig: Rig) -> bytes:
    """Return the numbers that two rigs of equal cameras have in common."""
    return b"".join(t.numpy().tobytes() for c in two(rig).pair(ALPHA, BETA).cameras for t in (c.K, c.R, c.t))


def _row(
    network: Comparing,
    point: Point,
    name: str,
    field: ReceptiveField | Way,
    number: int,
    scene: RecordedScene,
) -> Row:
    way = field if isinstance(field, Way) else Directly(field)
    began = time.perf_counter()
    try:
        result = way.fuse(network, two(point.assumed), scene.images)
    except ValueError as error:
        return Row(point.sweep, point.value, name, number, note=f"{error}".partition(":")[0])
    seconds = time.perf_counter() - began
    psnr, ssim = score(result.image.clamp(0, 1), scene.ground_truth)
    return Row(point.sweep, point.value, name, number, psnr, ssim, result.peaks(scene), seconds)


@torch.no_grad()
def fused(network: Comparing, pair: Pair, alpha: Tensor, beta: Tensor, field: ReceptiveField) -> Result:
    """The network on two whole images (C, H, W); beta's bands are cameras to one of several betas."""
    betas = [beta[None]] if network.betas == 1 else list(beta[None].split(1, dim=1))
    on_grid = FieldOnGrid.from_field(field, pair, blocks=False)
    output, compared = network.compare(Inputs.from_images(alpha[None], betas, [on_grid] * len(betas)))
    peaks = [peak_position(one)[0].movedim(0, -1).double() for one in compared]
    return Result(output.image[0], torch.stack(peaks))


def two(rig: Rig) -> Rig:
    """The first two cameras: alpha, beta. Raises ValueError unless calibrated, with a depth range."""
    first, second = rig.names[:2]
    cameras = rig.pair(first, second).cameras
    for name, camera in zip((first, second), cameras):
        if camera.distortion is not None:
            model = camera.distortion.model
            raise ValueError(
                f"these scenes are made for pinholes and '{name}' has a lens ({model}): "
                "give scenes of your own to pat.lab.evaluation.ablation.ablate"
            )
    near, far = (float(d) for d in rig.pair(first, second).depth_range)
    return Rig(dict(zip((ALPHA, BETA), cameras)), depth=(near, far))


def made(rig: Rig, bank: PhotoBank, number: int) -> RecordedScene:
    """Scene `number`, of the same things whatever the rig, recorded with some noise."""
    g = generator_for(0, "sweep", number)
    pair = rig.pair(ALPHA, BETA)
    near, far = (torch.full((1,), float(d), dtype=torch.float64) for d in pair.depth_range)
    cameras = [stack([in_frame_of(pair.cameras[0], camera)]) for camera in pair.cameras]
    batch = LayeredScenes(bank, RigDistribution(), hw=pair.alpha.hw).render(RigBatch(cameras, near, far), g)
    position, visible = seen_at(pair, *(depth[0].double() for depth in batch.depth))
    ground_truth, beta_image = (image[0] for image in batch.images)
    images = recorded({ALPHA: luminance(ground_truth), BETA: beta_image}, g)
    return RecordedScene(images, ground_truth, position, visible)


def seen_at(
    pair: Pair, depth: Float[Tensor, "h w"], beta_depth: Float[Tensor, "hb wb"]
) -> tuple[Float[Tensor, "h w 2"], Bool[Tensor, "h w"]]:
    """Where alpha's pixels are in beta, and whether beta sees the same surface there, to 2 % of its depth."""
    alpha, beta = pair.cameras
    projected = beta.project(alpha.unproject(pixel_grid(alpha.hw, dtype=torch.float64), depth))
    there = sample(beta_depth[None, None], projected.x[None], interpolation="nearest")
    same = (there.values[0, 0] / projected.depth - 1).abs() < 0.02
    return projected.x, projected.valid & there.valid[0] & same


SWEEPS: dict[str, tuple[str, tuple[float, ...]]] = {
    "rotation": ("error of beta's rotation, degrees", (0, 0.1, 0.2, 0.3, 0.5, 1.0)),
    "principal point": ("error of beta's principal point, pixels", (0, 2, 5, 10, 20)),
    "baseline": ("parallax of the nearest points, pixels", (6, 12, 24, 48)),
    "focal ratio": ("alpha's focal length over beta's", (1, 1.5, 2, 3, 4)),
    "ahead": ("direction of the baseline, degrees from across to ahead", (0, 30, 60, 90)),
}
"""Label of each sweep, and its values."""


def points(sweeps: Sequence[str] = tuple(SWEEPS), *, hw: HW = SIZE) -> Iterator[Point]:
    """The rigs of sweeps. Raises ValueError for a sweep that there is not."""
    refuse_unknown("no sweep", sweeps, SWEEPS)
    for name in sweeps:
        for value in SWEEPS[name][1]:
            yield point(name, value, hw=hw)


def point(sweep: str, value: float, *, hw: HW = SIZE) -> Point:
    """One rig of a sweep."""
    options = {"baseline": {"parallax": value}, "focal ratio": {"ratio": value}, "ahead": {"ahead": value}}
    assumed = rig = rig_of(hw, **options.get(sweep, {}))
    if sweep == "rotation":
        assumed = turned(rig, math.radians(value) * _unit(1.0, 1.0, 1.0))
    if sweep == "principal point":
        assumed = rig.perturbed({f"{BETA}.centre": value * _unit(1.0, 1.0)})
    return Point(sweep, float(value), rig, assumed)


def rig_of(hw: HW, *, parallax: float = PARALLAX, ratio: float = 1.0, ahead: float = 0.0) -> Rig:
    """Alpha, and a beta with a shorter focal length, to its right and `ahead` degrees of that forwards."""
    K = intrinsics(1.2 * hw[1], hw)
    alpha = Camera(K=K, cam_from_world=Pose.identity(), hw=hw)
    angle = math.radians(ahead)
    centre = parallax * NEAR / float(K[0, 0]) * _unit(math.cos(angle), 0.2 * math.cos(angle), math.sin(angle))
    R = rotation_from_vector(math.radians(TILT) * _unit(0.3, 0.5, 1.0))
    shorter = torch.diag(torch.tensor([1 / ratio, 1 / ratio, 1.0], dtype=torch.float64))
    K_beta = torch.cat([(K @ shorter)[:, :2], K[:, 2:]], 1)
    beta = Camera(K=K_beta, cam_from_world=Pose(R, -R @ centre), hw=hw)
    return Rig({ALPHA: alpha, BETA: beta}, depth=(NEAR, FAR))


def _unit(*numbers: float) -> Tensor:
    vector = torch.tensor(numbers, dtype=torch.float64)
    return vector / vector.norm()
