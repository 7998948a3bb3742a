"""Ablation of calibration: one checkpoint with every family of receptive fields on the same scenes.

Reproduces the paper's comparison of calibrated and rectified fields.
"""

from __future__ import annotations

import logging
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

import numpy as np
import torch
from jaxtyping import Float
from rich.progress import track
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d

from arraygeom import (
    Camera,
    Curved,
    Dense,
    Epipolar,
    HomographyDisplacement,
    Local,
    NearestVoxels,
    Pair,
    Pose,
    ReceptiveField,
    Rectified,
    Rig,
    Segments,
    apply_homography,
    pinhole_view,
    pixel_grid,
    rotation_from_vector,
)
from arraygeom.fields.default import natural_bounds
from arraygeom.fields.ray_depth import rough_transfer
from arraygeom.fields.straight import covering_displacement
from arraygeom.pixels import HW, coarse_grid
from arraygeom.runtime.atomic import write_text
from arraygeom.segments import clip_to_image

from ...fusion.classical import classical
from ...fusion.fuse import FuseSettings, fuse_frame
from ...fusion.steps import has_lens, resolution_ratio
from ...fusion.views import dense_bytes
from ...media.colour import luminance, srgb_image
from ...media.depth_maps import at_distance
from ...media.figures import save_panels
from ...networks.protocol import FusionNetwork
from ...sensors import Clip, Noise, Quantise, record
from ...support.metrics import score
from ..data.windows import reading, scene_folders
from ..synthesis.layered import LayeredScenes
from ..synthesis.photos import PhotoBank
from ..synthesis.rendered import Rendered
from ..synthesis.rig_distribution import RigDistribution
from .rectified import rectified
from .tables import grouped, interval_cell, markdown_table, write_csv

LOG = logging.getLogger(__name__)

ALPHA, BETA = "alpha", "beta"
RIGS = RigDistribution(
    mode="general",
    parallax=(8.0, 60.0),
    focal_ratio=(1 / 3, 1.0),
    resolutions=(1.0,),
    rotation=3.0,
    decentring=0.05,
)
"""Rigs of the layered scenes: beta's focal length is 1/3 to 1 of alpha's, at equal image sizes."""
DENSE_LIMIT = 2**31
"""Bytes of explicit positions above which the dense field is omitted."""
RATIOS = (1.0, 1.5, 2.0)
"""Lower bounds of the table's groups of focal ratios; lower ratios form one more group."""
CROP = 96
"""Side in pixels of the figure's crops."""
SHOWN = 4
"""Number of cases in the figure."""


class AblationCase(NamedTuple):
    """One scene of the ablation.

    Attributes:
        name: name in tables.
        rig: rig with cameras alpha and beta, and a depth range.
        images: recorded images (c, h, w), 0..1, by camera: alpha in grey, beta in colour.
        ground_truth: alpha's view in colour, (3, h, w), 0..1, sRGB.
        depth: true depth of alpha's pixels in metres, (h, w); infinite or NaN where there is none.
    """

    name: str
    rig: Rig
    images: dict[str, Tensor]
    ground_truth: Tensor
    depth: Tensor

    @property
    def ratio(self) -> float:
        """Alpha's focal length divided by beta's."""
        alpha, beta = self.rig.pair(ALPHA, BETA).cameras
        return float(alpha.K[0, 0] / beta.K[0, 0])


@dataclass(frozen=True)
class FieldFamily:
    """Family of receptive fields, and the rig that the field is computed from.

    Attributes:
        field: makes the field from the largest displacement from H x, pixels of beta; None from it means the
            default field.
        assumed: returns the (possibly wrong) rig to fuse with, given the true one and a generator.
        warped: True to rectify both images by that rig first and to warp the result back.
    """

    field: Callable[[float], ReceptiveField | None]
    assumed: Callable[[Rig, Generator], Rig] = lambda rig, g: rig
    warped: bool = False

    def fuse(self, network: FusionNetwork, rig: Rig, case: AblationCase, far: float) -> tuple[Tensor, Tensor]:
        """Fuse a case with this family's field.

        Args:
            rig: rig to fuse with, calibrated rightly or wrongly; `assumed` is left to the caller.
            far: largest displacement from H x, pixels of beta.

        Returns:
            Alpha's fused view (3, h, w), possibly beyond 0..1, and its depth (h, w) as `Frame.depth`, NaN
            where unknown.

        Raises:
            ValueError: as `fuse_frame`, such as for a field that the network does not support; if `warped`,
                also as `rectified`. Further errors as `fuse_frame`.
        """
        settings = FuseSettings(field=self.field(far))
        if not self.warped:
            frame = fuse_frame(case.images, rig, alpha=ALPHA, network=network, settings=settings)
            return frame.image, frame.depth
        level = rectified(rig, case.images)
        frame = fuse_frame(level.images, level.rig, alpha=ALPHA, network=network, settings=settings)
        return level.back(frame.image), level.depth_back(frame.depth)


class AblationRow(NamedTuple):
    """Result of one family on one scene.

    Attributes:
        scene: name of the case.
        ratio: alpha's focal length over beta's.
        family: name of the family, or of a baseline.
        psnr: PSNR in dB; NaN if there is no result.
        ssim: SSIM; NaN if there is no result.
        end_point_error: mean error in pixels of beta of the points at the estimated depth; NaN for baselines,
            without a result, and if no pixel can be compared.
        within_one: share of pixels of known true depth whose point is within a pixel of its true position in
            beta; NaN likewise.
        note: reason for a missing result; else empty.
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
class HorizontalDisplacement:
    """Field along rows around H x (`Pair.homography`): rectified geometry with correct position and scale.

    Attributes:
        disparity: half length of the segment, pixels of beta.
    """

    disparity: float

    def __call__(self, pair: Pair, x: Float[Tensor, "*n 2"]) -> Segments:
        """Compute horizontal segments in beta around H x, for pixels x of alpha, clipped to beta's image.

        Returns:
            Segments from right to left, (*n); invalid where H x is infinite or they miss beta's image.

        Raises:
            ValueError: as `Pair.homography`.
        """
        centre, finite = apply_homography(pair.homography, x)
        step = centre.new_tensor([self.disparity, 0.0])
        segments = clip_to_image(centre + step, centre - step, pair.beta.hw)
        return Segments(segments.start, segments.end, segments.valid & finite)


def families() -> dict[str, FieldFamily]:
    """Make every family of receptive fields of the ablation.

    Returns:
        Families by name. With the true rig: "calibrated", "rectified, warped", "rectified assumption", "rows
        around H x", "homography + displacement", "nearest voxels", "local 5x5" and "dense". With a wrong
        one: beta "rotated by A deg" for A of 0.1, 0.3 and 1, or its "centre off by P px" for P of 1, 3, 10.
    """
    exact = {
        "calibrated": FieldFamily(lambda disparity: None),  # the default
        "rectified, warped": FieldFamily(lambda disparity: Epipolar(), warped=True),
        "rectified assumption": FieldFamily(lambda disparity: Rectified(2 * disparity, alpha_is="either")),
        "rows around H x": FieldFamily(HorizontalDisplacement),
        "homography + displacement": FieldFamily(HomographyDisplacement),
        "nearest voxels": FieldFamily(lambda disparity: NearestVoxels()),
        "local 5x5": FieldFamily(lambda disparity: Local()),
        "dense": FieldFamily(lambda disparity: Dense()),
    }
    wrong = {f"rotated by {a:g} deg": partial(_rotated, a) for a in (0.1, 0.3, 1.0)}
    wrong |= {f"centre off by {p:g} px": partial(_decentred, p) for p in (1, 3, 10)}
    return exact | {name: FieldFamily(lambda disparity: Epipolar(), rig) for name, rig in wrong.items()}


def disparity(network: FusionNetwork, pair: Pair) -> float:
    """Bound the displacement in beta of a point over the depth range.

    Args:
        network: network that beta may be resized for.

    Returns:
        The largest displacement from H x, 1 or more, pixels of beta as the network receives it: of its
        pinhole view if it has a lens, and resized if the network needs equal resolutions and beta's is at
        most 0.8 or at least 1.25 of alpha's. Where a camera has no pinhole view, the largest distance, on
        beta's image, from the middle of a pixel's curve.

    Raises:
        ValueError: for a pair that is not calibrated or has no depth range.
    """
    if pair.has_lens and all(view.has_pinhole_view for view in pair.cameras):
        alpha, beta = (pinhole_view(view) if has_lens(view) else view for view in pair.cameras)
        pair = Pair(alpha, beta, pair.depth)
    if pair.has_lens:
        grid = coarse_grid(pair.alpha.hw).reshape(-1, 2).double()
        segments = Curved(bounds=natural_bounds(pair))(pair, grid)
        rough = rough_transfer(pair, grid)
        reached = (segments.xy - rough.x[:, None]).norm(dim=-1)
        far = float(torch.where(segments.mask & rough.valid[:, None], reached, 0.0).max())
    else:
        far = float(covering_displacement(pair))
    scale = resolution_ratio(pair)
    resized = network.equal_resolution and not 0.8 < scale < 1.25
    return max(far / (scale if resized else 1.0), 1.0)


def layered_cases(
    count: int, *, photos: Sequence[Path] = (), hw: HW = (240, 320), seed: int = 0
) -> Iterator[AblationCase]:
    """Render cases from layered photographs by rigs of `RIGS`, recorded as `recorded` does.

    Args:
        count: number of cases.
        photos: folders of photographs; empty for the textures of `sample_photographs`.
        hw: (height, width) of both images.
        seed: seed of the scenes and the noise.

    Yields:
        One case at a time, its depth range at either end 10 % wider than alpha's finite depths.

    Raises:
        ValueError: if no image is found, when the first case is asked for; OSError for an unreadable one.
    """
    bank = PhotoBank.load(*photos) if photos else sample_photographs()
    scenes, g = LayeredScenes(bank, RIGS, hw=hw, seed=seed), Generator().manual_seed(seed)
    for number in range(count):
        made = scenes.sample(1, g)
        ground_truth, beta_image = (image[0] for image in made.images)
        cameras = {name: camera[0].to(torch.float64) for name, camera in zip((ALPHA, BETA), made.cameras)}
        yield _recorded(f"scene {number}", Rig(cameras), ground_truth, beta_image, made.depth[0][0], g)


def rendered_cases(folder: Path, *, seed: int = 0) -> Iterator[AblationCase]:
    """Read cases from rendered scenes (`scene_folders`): their first camera is alpha, their second beta.

    Returns:
        Iterator over the cases, read on demand, with noise (`recorded`) drawn from `seed` anew for each, and
        a depth range at either end 10 % wider than alpha's finite depths. It raises ValueError for a damaged
        scene, one camera, or an alpha without finite depths.

    Raises:
        FileNotFoundError: for a missing folder.
        ValueError: for a folder without scenes, or with an incomplete one.
    """

    def case(path: Path) -> AblationCase:
        scene, g = Rendered(path), Generator().manual_seed(seed)
        with reading(path):
            names = scene.rig.names[:2]
            frames = [scene.frame(name) for name in names]
        if len(names) < 2:
            raise ValueError(f"{path}: has one camera, and alpha and beta are needed")
        ground_truth, beta_image = (srgb_image(f.rgb) for f in frames)
        rig = Rig(dict(zip((ALPHA, BETA), (scene.rig[name] for name in names))))
        return _recorded(path.name, rig, ground_truth, beta_image, frames[0].depth, g)

    return map(case, scene_folders(folder))


def _recorded(
    name: str, rig: Rig, ground_truth: Tensor, beta_image: Tensor, depth: Tensor, g: Generator
) -> AblationCase:
    """Case of two ideal images, with noise and a depth range 10 % wider than the scene's."""
    finite = depth[depth.isfinite()]
    if not len(finite):
        raise ValueError(f"{name}: alpha sees nothing, all its depths are infinite or unknown")
    images = recorded({ALPHA: luminance(ground_truth), BETA: beta_image}, g)
    rig = rig.replace(depth=(float(finite.min()) / 1.1, float(finite.max()) * 1.1))
    return AblationCase(name, rig, images, ground_truth, depth)


def recorded(ideal: Mapping[str, Tensor], g: Generator) -> dict[str, Tensor]:
    """Simulate recording by a good camera: little noise, 8 bits.

    Args:
        ideal: images (c, h, w), sRGB in 0..1, by name.
        g: generator of the noise.

    Returns:
        Images (c, h, w) in 0..1 by name.
    """
    steps = [Noise(8000, 3), Clip(), Quantise(8)]
    return {name: record(image[None], steps, g)[0] for name, image in ideal.items()}


def sample_photographs(*, count: int = 12, seed: int = 0) -> PhotoBank:
    """Load four photographs of scikit-image, and `count` patterns drawn from `seed`.

    Returns:
        Bank of textures, the photographs first: astronaut (NASA), chelsea, coffee and rocket (CC0).
    """
    from skimage import io
    from skimage.data import data_dir

    from ..synthesis.patterns import patterns

    names = ("astronaut.png", "chelsea.png", "coffee.png", "rocket.jpg")
    images = [io.imread(Path(data_dir) / name)[..., :3] for name in names]
    return PhotoBank(images + patterns(np.random.default_rng(seed), count), photos=len(images))


def ablate(
    network: FusionNetwork, cases: Iterable[AblationCase], chosen: Mapping[str, FieldFamily], *, out: Path
) -> list[AblationRow]:
    """Run families on cases; write ablation.md, ablation.csv and ablation.png (crops of the first cases).

    Args:
        cases: scenes, read one at a time, at least one.
        chosen: families by name.
        out: folder for the three files.

    Returns:
        One row for each case and each baseline ("alpha alone", "classical") or family. Where fusion raises
        ValueError, or dense positions would need more than `DENSE_LIMIT`, scores are NaN, with a note.

    Raises:
        ValueError: for no cases, and for one that is not calibrated, has no depth range, or is too small for
            SSIM; nothing is written then. Errors of `cases` and `assumed`, and others of fusion, pass.
        OSError: if a file cannot be written.
    """
    rows: list[AblationRow] = []
    panels: dict[str, Tensor] = {}
    for i, case in enumerate(track(cases, "ablating", disable=not sys.stderr.isatty())):
        result, images = _case(network, case, chosen)
        rows += result
        panels |= crops(case, images, result) if i < SHOWN else {}
    if not rows:
        raise ValueError("no scenes to compare on: give one or more")
    write_text(out / "ablation.md", markdown(rows))
    write_csv(out / "ablation.csv", AblationRow._fields, rows)
    save_panels(panels, out / "ablation.png", columns=6)
    return rows


def _case(
    network: FusionNetwork, case: AblationCase, chosen: Mapping[str, FieldFamily]
) -> tuple[list[AblationRow], dict[str, Tensor]]:
    """Rows of a case, and the images of the families that the network supports."""
    images = {"alpha alone": case.images[ALPHA].expand(3, -1, -1)}
    notes, errors, far = {}, {}, disparity(network, case.rig.pair(ALPHA, BETA))
    try:
        images["classical"] = classical(case.rig, case.images, ALPHA, BETA)
    except ValueError as error:
        notes["classical"] = str(error)
    for name, family in chosen.items():
        rig = family.assumed(case.rig, Generator().manual_seed(crc32(case.name.encode())))
        needed = dense_bytes(rig[ALPHA].hw, rig[BETA].hw)
        if isinstance(family.field(far), Dense) and needed > DENSE_LIMIT:
            notes[name] = f"does not fit: {needed / 2**30:.0f} GiB of positions"
            continue
        LOG.info("%s: %s", case.name, name)
        try:
            image, depth = family.fuse(network, rig, case, far)
        except ValueError as error:
            notes[name] = str(error).partition(":")[0]
            continue
        images[name], errors[name] = image.clamp(0, 1), point_errors(case, depth)
    names, none = ["alpha alone", "classical", *chosen], (math.nan, math.nan)
    scores = {name: score(image, case.ground_truth) for name, image in images.items()}
    figures = {name: (*scores.get(name, none), *errors.get(name, none)) for name in names}
    return [AblationRow(case.name, case.ratio, n, *figures[n], notes.get(n, "")) for n in names], images


def point_errors(case: AblationCase, depth: Float[Tensor, "h w"]) -> tuple[float, float]:
    """Compare estimated with true depth by the projection into beta, also for points that beta does not see.

    Args:
        case: scene with alpha's true depth.
        depth: estimated depth, metres, along what `natural_bounds` says, as the truth; NaN where unknown.

    Returns:
        Mean error in pixels of beta where both are known and finite, and share of the pixels of finite true
        depth with an error of at most 1; (nan, nan) if none can be compared.
    """
    alpha, beta = case.rig.pair(ALPHA, BETA).cameras
    x = pixel_grid(alpha.hw, dtype=torch.float64).reshape(-1, 2)
    unproject = at_distance if natural_bounds(case.rig.pair(ALPHA, BETA)) == "distance" else Camera.unproject
    estimated, true = (beta.project(unproject(alpha, x, d.reshape(-1).double())) for d in (depth, case.depth))
    has_truth = true.valid & true.x.isfinite().all(-1)
    compared = has_truth & estimated.valid & estimated.x.isfinite().all(-1)
    if not compared.any():
        return math.nan, math.nan
    error = (estimated.x - true.x).norm(dim=-1)[compared]
    return float(error.mean()), float((error <= 1).sum() / has_truth.sum())


def markdown(rows: Sequence[AblationRow]) -> str:
    """Format rows as an introduction and a Markdown table of one line for each family.

    Returns:
        The text. Columns: mean PSNR with 95 % bootstrap interval (of two scenes or more), mean SSIM, mean
        gain in PSNR over "calibrated" (dB), mean PSNR by focal ratio, both errors in beta, and last the first
        row's note if a family has no score at all, or how many scenes it lacks. Means are of the scenes that
        have the figure; blank where none has.
    """
    between = [f"ratio {low:g} to {high:g}" for low, high in pairwise(RATIOS)]
    bins = [f"ratio below {RATIOS[0]:g}", *between, f"ratio from {RATIOS[-1]:g}"]
    columns = ["family", "PSNR", "SSIM", "against calibrated", *bins, "off, px", "within 1 px", ""]
    lines = [[name, *_cells(own, rows)] for name, own in grouped(rows, "family").items()]
    scenes = len({row.scene for row in rows})
    interval = ", behind it a 95% interval" if scenes > 1 else ""
    note = (
        f"{_scenes(scenes)}; the focal ratio is alpha's focal length over beta's. PSNR in dB{interval}.\n"
        "Rectified, warped: both images are rectified by the calibration, and the result is "
        "warped back. The\nrectified assumption takes lines of the images as they are for rows, and both "
        "images for the same field of\nview; 'rows around H x' is given position and scale, and takes only "
        "the lines for rows. Off: mean error in\nbeta of points at the depth found.\n\n"
    )
    return note + markdown_table(columns, lines, align="l" + "r" * (len(columns) - 2) + "l")


def _cells(rows: Sequence[AblationRow], every: Sequence[AblationRow]) -> list[str]:
    """Cells of one family's line, with all rows as reference."""
    served = [row for row in rows if not math.isnan(row.psnr)]
    if not served:
        return [""] * (len(RATIOS) + 6) + [rows[0].note]
    reference = {row.scene: row.psnr for row in every if row.family == "calibrated"}
    gains = [row.psnr - reference.get(row.scene, math.nan) for row in served]
    off, near = zip(*((row.end_point_error, row.within_one) for row in served))
    gain, error, within = map(_mean, (gains, off, near))
    psnr, ssim = [row.psnr for row in served], [row.ssim for row in served]
    groups = [[r.psnr for r in served if a <= r.ratio < b] for a, b in pairwise((0, *RATIOS, math.inf))]
    means = [f"{np.mean(g):.2f}" if g else "" for g in groups]
    note = "" if len(served) == len(rows) else f"{_scenes(len(rows) - len(served))} omitted"
    depth = ["", ""] if math.isnan(error) else [f"{error:.2f}", f"{within:.1%}"]
    gained = "" if math.isnan(gain) else f"{gain:+.2f}"
    image = [f"{np.mean(psnr):.2f}{interval_cell(psnr)}", f"{np.mean(ssim):.4f}", gained]
    return [*image, *means, *depth, note]


def _scenes(count: int) -> str:
    return f"{count} scene{'s' * (count != 1)}"


def _mean(values: Sequence[float]) -> float:
    """Mean of the values that are not NaN; NaN if there is none."""
    numbers = [value for value in values if not math.isnan(value)]
    return float(np.mean(numbers)) if numbers else math.nan


def crops(case: AblationCase, images: Mapping[str, Tensor], rows: Sequence[AblationRow]) -> dict[str, Tensor]:
    """Cut the square, of up to `CROP` pixels a side, where the mean squared error of "rectified assumption"
    exceeds that of "calibrated" most.

    Args:
        images: fused images (3, h, w) by family or baseline.
        rows: scores of the case, one for each family or baseline.

    Returns:
        The same crop (3, h, w) of the ground truth and of each row with an image, by title (case, family,
        PSNR of the whole image); from the top left corner if one of the two families has no image.
    """
    window = (slice(None), *_most_different(images, case.ground_truth))
    panels = {f"{case.name}: ground truth\nfocal ratio {case.ratio:.1f}": case.ground_truth[window]}
    for row in rows:
        if row.family in images:
            panels[f"{case.name}: {row.family}\n{row.psnr:.1f} dB"] = images[row.family][window]
    return panels


def _most_different(images: Mapping[str, Tensor], ground_truth: Tensor) -> tuple[slice, slice]:
    """Square of `crops`."""
    h, w = ground_truth.shape[1:]
    side = min(CROP, h, w)
    names = [n for n in ("rectified assumption", "calibrated") if n in images]
    errors = [(images[n] - ground_truth).square().mean(0) for n in names]
    worse = errors[0] - errors[1] if len(errors) == 2 else ground_truth[0] * 0
    lost = avg_pool2d(worse[None, None], side, stride=1)[0, 0]
    top, left = divmod(int(lost.argmax()), lost.shape[1])
    return slice(top, top + side), slice(left, left + side)


def _rotated(degrees: float, rig: Rig, g: Generator) -> Rig:
    """Beta rotated about a random axis."""
    axis = torch.randn(3, generator=g, dtype=torch.float64)
    return turned(rig, axis / axis.norm() * math.radians(degrees))


def turned(rig: Rig, rotation: Float[Tensor, "3"]) -> Rig:
    """Rotate beta about its centre.

    Args:
        rig: rig with cameras alpha and beta.
        rotation: rotation vector in beta's axes, radians.

    Returns:
        The rig, all else unchanged.

    Raises:
        ValueError: for a rig without these cameras, or not calibrated.
    """
    beta = rig.pair(ALPHA, BETA).cameras[1]
    turn = Pose(rotation_from_vector(rotation), torch.zeros(3).double())
    return rig.with_camera(BETA, beta.replace(cam_from_world=turn @ beta.cam_from_world))


def _decentred(pixels: float, rig: Rig, g: Generator) -> Rig:
    """Beta's principal point shifted in a random direction."""
    angle = 2 * math.pi * float(torch.rand((), generator=g))
    shift = torch.tensor([pixels * math.cos(angle), pixels * math.sin(angle)], dtype=torch.float64)
    return rig.perturbed({f"{BETA}.centre": shift})
