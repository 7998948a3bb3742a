"""Alignment of bands, measured: beside a homography, on stereo pairs as bands and multispectral cameras.

A patch counts around a corner of alpha's image that the alignment says the beta sees (with true disparity:
and whose patch it does see), if it can be located: its best match within some pixels of where the alignment,
or the homography, puts it is like it, and the best matches of its four halves are within half a pixel of
that (noise, or an edge of depth within the patch, draws them apart: the patch then has no one place). It is
well aligned if that match is within half a pixel.
The homography is OpenCV's ECC on gradients, coarse to fine, of images without their lenses, as the makers of
multispectral cameras align their bands.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from skimage.data import stereo_motorcycle
from torch import Tensor

from arraygeom import Camera, Pose, Rig, apply_homography, intrinsics, pixel_grid, sample
from arraygeom.runtime.atomic import write_text
from arraygeom.undistortion import pixels_between, recorded_pixels
from calib.boards.detect import collect_folder
from calib.boards.poses import StartDeviations
from calib.boards.rig import Calibration, calibrate
from calib.boards.target import parse_board
from calib.images.guided_matches import LEAST_SIMILARITY, guided_matches
from calib.images.matches import seen_depths
from calib.images.refinement import FREE, refine
from experiments.evaluation.halves import of_half
from experiments.names import refuse_unknown
from pat import FuseSettings, align
from pat.app.aligned_files import RecordedFiles
from pat.app.aligned_page import ndvi, shown_layers
from pat.app.from_images import array_from_images, camera_names
from pat.fusion.align import LEAST_CONFIDENCE, SEEN, Aligned, resampled_values
from pat.fusion.steps import without_lenses
from pat.fusion.views import ViewFiles
from pat.lab.data.pairs import PAPER_DISPARITY, Disparity, StereoPair, middlebury_pairs
from pat.lab.evaluation.protocols import rectified_rig
from pat.lab.evaluation.tables import markdown_table
from pat.media.figures import save_panels

HALF_PIXEL = 0.5
PATCH, SEARCH = 10, 5
"""Pixels from a patch's middle to its edge, and as far as its best match is searched."""
WHOLE = slice(-PATCH, PATCH + 1)
HALVES = slice(-PATCH, 1), slice(0, PATCH + 1)
PARTS = [(WHOLE, WHOLE), *((half, WHOLE) for half in HALVES), *((WHOLE, half) for half in HALVES)]
"""Rows and columns of a patch and of its halves, about its middle."""
POINTS, SPACING = 3000, 8
"""Corners of alpha at most, and their least distance, pixels."""
LEVELS = 4
"""Halvings of the images in which the homography is searched, coarse to fine."""
SCALE = np.diag([2.0, 2.0, 1.0])
BOARD = "chessboard:11x8:30mm"
CAMERAS = 9
ONE_BOARD = 0.1
"""Uncertainty of a lens calibrated by one board in a quarter of the picture, in units of `--sigma`; a round
number: .5 gives the same patches to a percent, a drift's .02 too few."""
WIDEST = 0.15
"""Largest disparity in the scene of nine bands that is searched, as a share of the width."""


class AlignmentRow(NamedTuple):
    """One beta of one scene. Shares of: corners (truly visible ones) that the alignment sees; of those,
    patches that can be located; of those, patches within half a pixel of their best match by the alignment,
    and by the homography; with the truth, patches within half a pixel of their best match if aligned by it,
    seen patches within half a pixel of it, and occluded pixels wrongly filled.

    median, median_homography: of the distances of patches from their best match, pixels (searched 5 along x
    and y). off: largest difference of the values, in their own units, from samples of the recorded image,
    rounded as they are.
    """

    scene: str
    beta: str
    seen: float
    located: float
    aligned: float
    homography: float
    median: float
    median_homography: float
    by_truth: float | None
    true: float | None
    filled: float | None
    off: float
    dtype: str


SHARES = "seen", "located", "aligned", "homography", "by_truth", "true", "filled"
MEDIANS = "median", "median_homography"


class AlignmentScene(NamedTuple):
    """A scene to align: rig, developed images, recorded values, alpha, and its true disparity if
    it is known."""

    name: str
    rig: Rig
    images: Mapping[str, Tensor]
    recorded: Mapping[str, Any]
    alpha: str
    match_levels: bool
    recorded_rig: Rig | None = None
    truth: Disparity | None = None


def evaluate_alignment(data: Path, out: Path, names: Sequence[str], *, each: Callable[[str], None]) -> str:
    """Align the scenes of these names (`SCENES`) below `data`; write alignment.md, figures. Returns the text.

    `each` is given each scene's name before it is aligned. Raises ValueError for a name that there is not,
    FileNotFoundError for missing images.
    """
    refuse_unknown("no scene", names, SCENES)
    rows: list[AlignmentRow] = []
    indices: list[str] = []
    text = ""
    for name in names:
        for scene in SCENES[name](data):
            each(scene.name)
            aligned = aligned_scene(scene)
            rows += alignment_rows(scene, aligned)
            indices += index_text(scene, aligned)
            layers = {} if scene.truth is not None else shown_layers(aligned, scene.recorded_rig)
            name = f"{scene.name.replace('/', '-')}.png"
            save_panels({**composites(scene, aligned), **layers}, out / name, columns=2)
            text = "\n\n".join([alignment_markdown(rows), *indices])
            write_text(out / "alignment.md", text)
    return text


def index_text(scene: AlignmentScene, aligned: Aligned) -> list[str]:
    """A sentence on the vegetation index of a scene with red and near infrared; none for others."""
    index = ndvi(aligned, scene.recorded_rig)
    if scene.recorded_rig is None or index is None:
        return []
    low, median, high, raw = (
        float(np.nanquantile(values, q))
        for values, q in ((index, 0.1), (index, 0.5), (index, 0.9), (ndvi(aligned), 0.5))
    )
    return [
        f"NDVI of {scene.name}, where both bands are seen, from counts less the black level, by exposure and "
        f"gain: {median:.2f} (median), {low:.2f} to {high:.2f} in 8 of 10 pixels; of plain counts {raw:.2f}."
    ]


def aligned_scene(scene: AlignmentScene, min_confidence: float = LEAST_CONFIDENCE) -> Aligned:
    """Its bands at the pixels of alpha."""
    settings = FuseSettings(match_levels=scene.match_levels)
    how: dict[str, Any] = {"recorded": scene.recorded, "min_confidence": min_confidence}
    return align(scene.images, scene.rig, alpha=scene.alpha, settings=settings, **how)


def alignment_rows(scene: AlignmentScene, aligned: Aligned) -> list[AlignmentRow]:
    """The figures of every beta."""
    alpha_band = shown_band(aligned[scene.alpha].values)
    corners = cv2.goodFeaturesToTrack(alpha_band, POINTS, 1e-3, SPACING)[:, 0].round().astype(int)
    h, w = alpha_band.shape
    reach = PATCH + SEARCH
    corners = corners[((corners >= reach) & (corners < np.array([w, h]) - reach)).all(1)]
    straight, pinhole = without_lenses(scene.rig, scene.images)
    truth = scene.truth
    visible: NDArray[np.bool_] = np.ones((h, w), bool)
    if truth is not None:
        expected = pixel_grid((h, w)).numpy().copy()
        expected[..., 0] -= truth.value.numpy()
        regions = truth.regions()
        occluded, visible = regions.occluded.numpy(), regions.seen.numpy() & (expected[..., 0] >= 0)
    whole = cv2.blur(visible.astype(float), (2 * PATCH + 1, 2 * PATCH + 1)) > 1 - 1e-6
    candidates = corners[whole[corners[:, 1], corners[:, 0]]]
    rows = []
    for name in scene.rig.betas(scene.alpha):
        view, values = aligned[name], np.asarray(scene.recorded[name])
        valid = view.valid[candidates[:, 1], candidates[:, 0]]
        x = candidates[valid]
        planes = [np.nan_to_num(view.positions), by_homography(scene, name, straight, pinhole)]
        true, filled = None, None
        if truth is not None:
            planes.append(expected)
            error = np.linalg.norm(view.positions - expected, axis=-1)[x[:, 1], x[:, 0]]
            true = float((error <= HALF_PIXEL).mean())
            filled = float((view.visibility[occluded] == SEEN).mean()) if occluded.any() else 0.0
        others = [shown_band(resampled_values(values, plane, "bilinear")) for plane in planes]
        offsets, locatable = zip(*(local_offsets(alpha_band, other, x) for other in others))
        located = locatable[0] | locatable[1]
        near = [float((off[located] <= HALF_PIXEL).mean()) for off in offsets]
        rows.append(
            AlignmentRow(
                scene.name,
                name,
                seen=float(valid.mean()),
                located=float(located.mean()),
                aligned=near[0],
                homography=near[1],
                median=float(np.median(offsets[0][located])),
                median_homography=float(np.median(offsets[1][located])),
                by_truth=near[2] if len(near) > 2 else None,
                true=true,
                filled=filled,
                off=sampling_error(view, values),
                dtype=str(view.values.dtype),
            )
        )
    return rows


def composites(scene: AlignmentScene, aligned: Aligned) -> dict[str, Float[Tensor, "3 h w"]]:
    """The first two betas as red and blue and alpha as green: by the homography, and aligned."""
    straight, pinhole = without_lenses(scene.rig, scene.images)
    names = scene.rig.betas(scene.alpha)[:2]
    images: list[list[NDArray[Any]]] = [[], []]
    for name in names:
        values, view = np.asarray(scene.recorded[name]), aligned[name]
        by_plane, by_scene = (
            resampled_values(values, plane, "bilinear")[0] * (0.95 / np.percentile(values[0], 99))
            for plane in (by_homography(scene, name, straight, pinhole), np.nan_to_num(view.positions))
        )
        images[0].append(by_plane)
        images[1].append(np.where(view.valid, by_scene, 1.0))
    alpha_band = aligned[scene.alpha].values[0]
    green = alpha_band * (0.95 / np.percentile(alpha_band, 99))
    unseen = np.any([~aligned[name].valid for name in names], 0)
    titles = "by a homography", "by pat align, white where not seen"
    panels = {}
    for title, (red, *further), middle in zip(titles, images, (green, np.where(unseen, 1.0, green))):
        bands = np.stack([red, middle, (further or [red])[0]])
        panels[title] = torch.from_numpy(bands.clip(0, 1).astype(np.float32))
    return panels


def local_offsets(
    alpha: NDArray[np.uint8], beta: NDArray[np.uint8], x: NDArray[Any]
) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Compute the distance from each pixel x (n, 2) to the patch of `beta` that is most similar to alpha's
    there.

    Similarity is correlation squared, which does not depend on the sign of a band's contrast. The peak is
    found by a parabola.

    Returns:
        Distances in pixels, and a mask of the patches that can be located: similar, and with halves that
        agree.
    """
    offsets, like = zip(*(_best_match(alpha, beta, pixel) for pixel in x)) if len(x) else ([], [])
    best = np.reshape(offsets, (len(x), len(PARTS), 2))
    agree = np.linalg.norm(best[:, 1:] - best[:, :1], axis=-1).max(1) <= HALF_PIXEL
    return np.linalg.norm(best[:, 0], axis=-1), agree & (np.array(like) >= LEAST_SIMILARITY)


def _best_match(
    alpha: NDArray[np.uint8], beta: NDArray[np.uint8], pixel: NDArray[Any]
) -> tuple[list[tuple[float, float]], float]:
    """Return the offsets (y, x) of the best matches of the patch and its halves, and the patch's
    similarity."""
    offsets, like = [], []
    for section in PARTS:
        rows, columns = (slice(centre + s.start, centre + s.stop) for centre, s in zip(pixel[::-1], section))
        around = (slice(s.start - SEARCH, s.stop + SEARCH) for s in (rows, columns))
        matched = cv2.matchTemplate(beta[tuple(around)], alpha[rows, columns], cv2.TM_CCOEFF_NORMED)
        scores = np.square(np.nan_to_num(matched))
        best = np.unravel_index(int(scores.argmax()), scores.shape)
        like.append(float(scores[best]))
        offsets.append((_peak(scores, best, 0) - SEARCH, _peak(scores, best, 1) - SEARCH))
    return offsets, like[0]


def _peak(scores: NDArray[Any], best: Sequence[Any], axis: int) -> float:
    """The position along an axis of the parabola's peak through the largest value and its neighbours."""
    index = int(best[axis])
    if not 0 < index < scores.shape[axis] - 1:
        return float(index)
    before, middle, after = np.take(scores, best[1 - axis], 1 - axis)[index - 1 : index + 2]
    bend = before - 2 * middle + after
    return index + (0.0 if bend >= 0 else float(0.5 * (before - after) / bend))


def by_homography(
    scene: AlignmentScene, name: str, straight: Rig, pinhole: Mapping[str, Tensor]
) -> Float[np.ndarray, "h w 2"]:
    """Where alpha's recorded pixels are in beta's recorded image by the homography of lensless images."""
    alpha = scene.alpha
    alpha_band, beta_band = (shown_band(pinhole[n].numpy()) for n in (alpha, name))
    H = torch.from_numpy(ecc_homography(alpha_band, beta_band))
    x, _ = pixels_between(straight[alpha], scene.rig[alpha])
    return recorded_pixels(apply_homography(H, x).x, straight[name], scene.rig[name])[0].float().numpy()


def ecc_homography(alpha: NDArray[np.uint8], beta: NDArray[np.uint8]) -> Float[np.ndarray, "3 3"]:
    """The homography `alpha` to `beta` by enhanced correlation (Evangelidis, Psarakis 2008) of gradients.

    It starts from a translation by phase correlation, or from none; no level may lower the correlation.
    """
    a, b = (_gradients(image, 0.5**LEVELS) for image in (alpha, beta))
    b = np.asarray(cv2.resize(b, a.shape[::-1]), np.float32)
    shifted = np.eye(3)
    shifted[:2, 2] = cv2.phaseCorrelate(a, b, cv2.createHanningWindow(a.shape[::-1], cv2.CV_32F))[0]
    H: NDArray[Any] = max([np.eye(3), shifted], key=lambda H: _correlation(a, b, H))
    ecc: Any = cv2.findTransformECC
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-5)
    for level in range(LEVELS, -1, -1):
        a, b = (_gradients(image, 0.5**level) for image in (alpha, beta))
        if level < LEVELS:
            H = SCALE @ H @ np.linalg.inv(SCALE)
        try:
            _, refined = ecc(a, b, H.astype(np.float32), cv2.MOTION_HOMOGRAPHY, criteria, None, 5)
        except cv2.error:  # it does not converge on this level
            continue
        H = max([H, refined], key=lambda H: _correlation(a, b, H))
    return np.asarray(H, np.float64)


def _correlation(a: NDArray[Any], b: NDArray[Any], H: NDArray[Any]) -> float:
    """Return the correlation of gradients with those of the other image, warped by a homography."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return float(cv2.computeECC(a, cv2.warpPerspective(b, H.astype(np.float64), a.shape[::-1], flags=flags)))


def _gradients(image: NDArray[np.uint8], factor: float) -> NDArray[np.float32]:
    small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.asarray(np.hypot(cv2.Sobel(small, -1, 1, 0), cv2.Sobel(small, -1, 0, 1)), np.float32)


def sampling_error(view: Any, values: NDArray[Any]) -> float:
    """An aligned view's largest difference from samples of what was recorded, rounded if those are."""
    where = torch.from_numpy(view.positions[view.valid]).double()[None]
    taken = sample(torch.from_numpy(values.astype(np.float64))[None], where).values[0].numpy()
    if np.issubdtype(values.dtype, np.integer):
        taken = np.rint(taken)
    return float(np.abs(view.values[:, view.valid] - taken).max())


def shown_band(values: NDArray[Any]) -> NDArray[np.uint8]:
    """The first band, stretched to 8 bits, its contrast equalised."""
    plane = np.nan_to_num(values[0].astype(np.float32))
    low, high = np.percentile(plane, (0.5, 99.5))
    grey = np.clip((plane - low) / max(high - low, 1e-9) * 255, 0, 255).astype(np.uint8)
    return cv2.createCLAHE(3, (8, 8)).apply(grey)


def alignment_markdown(rows: Sequence[AlignmentRow]) -> str:
    """A line for each beta; of the pairs of a set (SET/NAME) one of their means."""
    lines, pairs = [], [row for row in rows if "/" in row.scene]
    for name in dict.fromkeys(row.beta for row in pairs):
        mine = [row for row in pairs if row.beta == name]
        means: dict[str, Any] = {n: np.mean([getattr(row, n) for row in mine]) for n in (*SHARES, *MEDIANS)}
        scene, off = f"{len(mine)} pairs", max(row.off for row in mine)
        lines.append(_line(mine[0]._replace(scene=scene, off=off, **means)))
    lines += [_line(row) for row in rows if row not in pairs]
    columns = [
        *("", "seen", "located", "within .5 px", "by a homography", "by the true disparities"),
        *("positions within .5 px of the true ones", "occluded pixels filled"),
        *("median px, alignment / homography", "values off"),
    ]
    return markdown_table(columns, lines)


def _line(row: AlignmentRow) -> list[str]:
    values = [getattr(row, share) for share in SHARES]
    shares = ["" if share is None else f"{share:.1%}" for share in values]
    medians = f"{row.median:.2f} / {row.median_homography:.2f}"
    return [f"{row.scene}, {row.beta}", *shares, medians, f"{row.off:.1g} ({row.dtype})"]


# Scenes -----------------------------------------------------------------------------------------------------


def middlebury_scenes(data: Path) -> Iterator[AlignmentScene]:
    """Green of the left image, red and blue of the right: three one-band cameras, of the report half."""
    for pair in of_half(middlebury_pairs(data / "middlebury"), "report"):
        if pair.disparity is not None and len(pair.left) == 3 and pair.left.shape == pair.right.shape:
            yield _as_bands(pair, pair.disparity)


def _as_bands(pair: StereoPair, truth: Disparity) -> AlignmentScene:
    hw = pair.left.shape[-2], pair.left.shape[-1]
    rig = rectified_rig(hw, {"red": hw, "blue": hw}, PAPER_DISPARITY)
    images = {"alpha": pair.left[1:2], "red": pair.right[0:1], "blue": pair.right[2:3]}
    recorded = {name: np.rint(image.numpy() * 255).astype(np.uint8) for name, image in images.items()}
    return AlignmentScene(pair.name, rig, images, recorded, "alpha", True, truth=truth)


def motorcycle_scene(data: Path) -> Iterator[AlignmentScene]:
    """Middlebury's motorcycle of 2014, as scikit-image ships it, as bands; `data` is not needed."""
    left, right, disparity = (torch.from_numpy(np.array(photo)) for photo in stereo_motorcycle())
    left, right = (photo.movedim(-1, 0) / 255 for photo in (left, right))
    truth = Disparity(disparity.nan_to_num(0.0, 0.0, 0.0).float(), disparity.isfinite() & (disparity > 0))
    yield _as_bands(StereoPair("motorcycle", left, right, PAPER_DISPARITY, truth), truth)


def capture(name: str, pattern: str) -> Callable[[Path], Iterator[AlignmentScene]]:
    """The scene of a capture whose files state their cameras by tags."""

    def scenes(data: Path) -> Iterator[AlignmentScene]:
        files = camera_names(sorted((data / "multispectral" / name).glob(pattern)))
        array = array_from_images(files)
        files = {camera: files[camera] for camera in array.rig.names}
        recorded = RecordedFiles(array.recorded, files)
        yield AlignmentScene(
            name, array.rig, array.images, recorded, array.alpha, array.match_levels, array.recorded
        )

    return scenes


def nine_band_start(folder: Path) -> Rig:
    """The array of nine bands as its makers state it: X to the right, Y up, parallel cameras."""
    stated = json.loads((folder / "camera_array.json").read_text())
    cameras = {}
    for i in range(CAMERAS):
        c = stated[f"Camera {i}"]
        hw = c["image_height"], c["image_width"]
        centre = torch.tensor([c["X"], -c["Y"], 0.0], dtype=torch.float64) * 1e-3
        pose = Pose.from_centre(torch.eye(3, dtype=torch.float64), centre)
        focal = c["focal_length"] / c["sensor_width"] * c["image_width"]
        cameras[f"Cam-{i}"] = Camera(K=intrinsics(focal, hw), cam_from_world=pose, hw=hw)
    return Rig(cameras)


def nine_band_calibration(folder: Path, deviations: StartDeviations) -> Calibration:
    """The array of nine bands from its image of a board by each camera."""
    start, board = nine_band_start(folder), parse_board(BOARD)
    patterns = {name: f"{name}.png" for name in start.names}
    views = collect_folder(folder / "calibration", board, patterns=patterns).views
    return calibrate(views, board, start=start, deviations=deviations)


def nine_band_scene(data: Path) -> Iterator[AlignmentScene]:
    """The array of nine bands, calibrated by its one board, refined by the scene, lenses too, as `pat rig
    refine` does it: the middle camera is alpha, the four beside it the betas."""
    folder, alpha = data / "nine_band_array", "Cam-4"
    rig = nine_band_calibration(folder, StartDeviations()).rig
    rig = Rig({name: rig[name] for name in (alpha, "Cam-1", "Cam-3", "Cam-5", "Cam-7")})
    files = {name: folder / "scene" / f"{name}.png" for name in rig.names}
    views = ViewFiles(rig, files, alpha=alpha)
    images = {name: views[name] for name in rig.names}
    depths = [_depths_seen(rig, images, alpha, name) for name in ("Cam-3", "Cam-5")]
    bounds = min(near for near, _ in depths), max(far for _, far in depths)
    start, free = views.developed.replace(depth=bounds), (*FREE, "distortion")
    refined = refine(start, [images], free=free, sigma={"distortion": ONE_BOARD}).rig
    yield AlignmentScene("nine-band", refined, images, RecordedFiles(rig, files), alpha, True)


def _depths_seen(rig: Rig, images: Mapping[str, Tensor], alpha: str, beta: str) -> tuple[float, float]:
    """Depth bounds of what parallel cameras of one size see, by patches matched between them."""
    pair = rig.pair(alpha, beta)
    shown = torch.ones(rig[alpha].hw, dtype=torch.bool), torch.ones(rig[beta].hw, dtype=torch.bool)
    window = round(WIDEST * max(rig[alpha].hw))
    eye = torch.eye(3, dtype=torch.float64)
    return seen_depths(pair, guided_matches(images[alpha], images[beta], eye, window=window, shown=shown))


SCENES: Mapping[str, Callable[[Path], Iterator[AlignmentScene]]] = {
    "motorcycle": motorcycle_scene,
    "middlebury": middlebury_scenes,
    "rededge": capture("rededge", "IMG*.tif"),
    "rededge_flight": capture("rededge_flight", "IMG*.tif"),
    "sequoia": capture("sequoia", "IMG*.TIF"),
    "nine-band": nine_band_scene,
}
