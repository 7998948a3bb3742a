"""Mono + colour fusion by OpenCV: the baseline that every evaluation reports.

Semi-global matching (Hirschmüller 2008) of luminances both ways, a left-right check, beta's colour
differences warped to alpha, and corrected by guided regression (He et al. 2013) on alpha's luminance. Unseen
pixels take the colours of the seen pixels most similar in luminance, texture and place; one edge-aware
smoother guided by alpha (Min et al. 2014) joins both. The result has alpha's luminance. The constants were
tuned for the mean PSNR of nine pairs of the tune half with beta reduced 2x.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from arraygeom import Camera, Pair, Rig
from arraygeom.checks import checked

from ..media.colour import from_luma_chroma, luminance, to_bytes
from ..media.figures import reduced
from ..media.filters import filled
from ..sensors import NoiseLevel
from ..support.neighbours import nearest_points
from .frame import Frame
from .steps import undistort
from .views import Views, grey_alpha, range_of

Image = NDArray[Any]

BLOCK = 5
"""Side of the matched block in pixels."""
CHECK = 1.0
"""Largest difference, in pixels, of the two disparities of a match that passes the left-right check."""
LIKENESS = 0.08
"""Difference of luminances at which the weight of a match falls to 1 / e."""
INCONSISTENT = 0.5
"""Weight of the colour of a pixel that fails the left-right check, before the likeness of luminances."""
REGRESSION_RADIUS, REGRESSION_FLOOR = 3, 3e-3
"""Window and regulariser (variance of luminance) of the regression of colour on luminance."""


EXAMPLES = 8
"""Number of seen pixels whose mean colour an unseen one takes."""
SEEN = 0.5
"""Weight above which a pixel counts as seen; unseen ones weigh `UNSEEN` in the last smoothing."""
UNSEEN = 0.2
DISPARITY_FILL, COLOUR_FILL, LAST_FILL = (50, 4), (300, 3), (30, 1.5)
"""Strength of the edge-aware smoothing, and the difference of 8-bit luminance that counts as an edge."""
MOST_DISPARITY = 3
"""Largest disparity, in widths of alpha's image: memory grows with its square."""
UNRECTIFIABLE = "the cameras look along the line between them: such a pair cannot be rectified"


def classical_baseline(rig: Rig, images: Mapping[str, Tensor], alpha: str) -> Float[Tensor, "_ h w"]:
    """Fuse by `classical` with the first beta that has an image if it is in colour, else with each beta.

    Returns:
        The fused bands (C, h, w), 0..1: red, green and blue of the first beta, or the bands of each beta, in
        order.

    Raises:
        ValueError: for no beta with an image, an alpha that the rig lacks, and as `classical`.
        KeyError: without an image of alpha.
    """
    betas = [name for name in rig.betas(alpha) if name in images]
    if not betas:
        raise ValueError(f"none of the betas of '{alpha}' has an image: give one of another camera")
    if images[betas[0]].shape[0] == 3:
        return classical(rig, images, alpha, betas[0])
    return torch.cat([classical(rig, images, alpha, name) for name in betas])


def classical_view(
    rig: Rig, images: Mapping[str, Tensor], alpha: str, *, longest: int
) -> Float[Tensor, "_ h w"]:
    """Fuse reduced images by `classical_baseline` at alpha's own view, through lenses.

    Args:
        images: images (C, h, w), 0..1, by camera, of the rig's sizes.
        longest: largest number of pixels of an image's longer side.

    Returns:
        The fused bands (C, h, w) at the pixels of the reduced alpha, lens included; not clipped with a lens.

    Raises:
        ValueError: for cameras that are not calibrated, and as `Views.of` and `classical_baseline`.
        TypeError: for images that are no tensors.
    """
    if names := [name for name in images if not isinstance(rig[name], Camera)]:
        raise ValueError(
            f"{', '.join(names)}: not calibrated, and the classical baseline needs poses and depths"
        )
    small = {}
    for name, image in images.items():
        range_of(name, image, rig[name].hw, exposed=True)
        small[name] = reduced(image, longest).clamp(0, 1)
        rig = rig.resize(name, (small[name].shape[-2], small[name].shape[-1]))
    views, back = undistort(Views.of(rig, small, alpha=alpha))
    image = classical_baseline(views.rig, views.images, alpha)
    return back(Frame(image, *torch.zeros(3, *image.shape[-2:]))).image


def classical(rig: Rig, images: Mapping[str, Tensor], alpha: str, beta: str) -> Float[Tensor, "_ h w"]:
    """Fuse two pinholes of any pose by semi-global matching: beta's colours, or one band, at alpha's view.

    Both are rectified to one image plane with about alpha's resolution and matched there for depths near to
    far; the colour differences (for one band: the excess of beta over alpha) are warped back to alpha.

    Args:
        images: images (C, h, w), 0..1, by camera, of the rig's sizes.
        alpha: name of alpha, in grey or colour.
        beta: name of the beta, of three bands or one.

    Returns:
        Three bands with alpha's luminance, or one, clipped to 0..1, at alpha's pixels; where beta does not
        see a pixel, by seen ones that are similar.

    Raises:
        ValueError: for unknown or uncalibrated cameras, lenses, no depth range, or a near bound far too near,
            images as `range_of` or of another number of bands, and cameras that look along the line between
            them or have one centre.
        KeyError: for a camera without an image.
        TypeError: for images that are no tensors.
    """
    pair = rig.pair(alpha, beta)
    for name in (alpha, beta):
        range_of(name, images[name], rig[name].hw, exposed=True)
    mono, other = grey_alpha(alpha, images[alpha]), images[beta]
    if len(other) not in (1, 3):
        raise ValueError(f"'{beta}' has {len(other)} bands: the classical baseline takes one or three")
    if pair.has_lens:
        raise ValueError("the classical baseline needs pinhole cameras: undistort the images first")
    plane = _rectified_plane(pair)
    left = _warped(_planes(mono), plane.from_alpha, plane.wh)
    right = _warped(_planes(other), plane.from_beta, plane.wh)
    ones = np.ones(pair.beta.hw, np.float32)
    inside: Image = cv2.warpPerspective(ones, plane.from_beta, plane.wh, flags=cv2.INTER_NEAREST)
    one, two = pair.cameras
    to_alpha, wh = np.linalg.inv(plane.from_alpha), (mono.shape[2], mono.shape[1])
    matched = left, right, inside, plane.max_disparity, float(two.K[0, 0] / one.K[0, 0])
    if len(other) == 3:
        return _recoloured(mono, _warped(_warped_chroma(*matched), to_alpha, wh))
    difference = _warped(_warped_band(*matched), to_alpha, wh)
    return (mono + torch.from_numpy(difference)[None].to(mono)).clamp(0, 1)


@checked
def classical_fusion(
    alpha: Float[Tensor, "1 h w"], beta: Float[Tensor, "3 hb wb"], max_disparity: float
) -> Float[Tensor, "3 h w"]:
    """Bring beta's colours to alpha, for a (near-)rectified pair with alpha on the left.

    Beta may have another size than alpha, as long as both have the same field of view: the point at (x, y) in
    alpha is at (x - d, y) in beta enlarged to alpha's size, 0 <= d <= `max_disparity`.

    Args:
        alpha: grey image, values 0..1.
        beta: colour image, values 0..1.
        max_disparity: largest disparity, in alpha's pixels.

    Returns:
        Red, green and blue with alpha's luminance, clipped to 0..1; where beta does not see a pixel, by seen
        ones that are similar.

    Raises:
        ValueError: for a `max_disparity` that is not positive, and images of other shapes.
        TypeError: for images that are no tensors of floats.
    """
    if not max_disparity > 0:
        raise ValueError(f"max_disparity must be positive, got {max_disparity}")
    mono, colours = _planes(alpha)[..., 0], _planes(beta)
    how = cv2.INTER_AREA if len(colours) > len(mono) else cv2.INTER_CUBIC
    colours = cv2.resize(colours, mono.shape[::-1], interpolation=how)  # c' = (c + 0.5) s - 0.5
    sharpness = beta.shape[2] / alpha.shape[2]
    chroma = _warped_chroma(mono, colours, np.ones_like(mono), max_disparity, sharpness)
    return _recoloured(alpha, chroma)


def non_local_means(image: Float[Tensor, "c h w"], deviation: float) -> Float[Tensor, "c h w"]:
    """Denoise an image by scikit-image's non-local means for noise of known deviation (Buades et al. 2005;
    Darbon et al. 2008).

    Patches of 5 x 5 pixels within 6 pixels, h = 0.8 deviations, as its documentation advises.

    Args:
        image: image, values 0..1, on the CPU and without a gradient.
        deviation: standard deviation of the noise, in the same values.

    Returns:
        The image without noise, not clipped.
    """
    from skimage.restoration import denoise_nl_means

    pixels = image.movedim(0, -1).numpy()
    denoised = denoise_nl_means(
        pixels, patch_size=5, patch_distance=6, h=0.8 * deviation, sigma=deviation, channel_axis=-1
    )
    return torch.from_numpy(np.ascontiguousarray(denoised.reshape(pixels.shape))).movedim(-1, 0).to(image)


def denoised_knowing(image: Float[Tensor, "c h w"], level: NoiseLevel) -> Float[Tensor, "c h w"]:
    """Denoise an image by `non_local_means` for the mean deviation of a noise level.

    Returns:
        The image without noise, 0..1.
    """
    return non_local_means(image, float(level.deviation(image[None]).mean())).clamp(0, 1)


class _Plane(NamedTuple):
    """A common image plane: maps of alpha's and beta's pixels into it, its size, its largest disparity."""

    from_alpha: NDArray[np.float64]
    from_beta: NDArray[np.float64]
    wh: tuple[int, int]
    max_disparity: float


def _rectified_plane(pair: Pair) -> _Plane:
    """Rotate both cameras so that x runs along the baseline (Fusiello et al. 2000).

    `arraygeom.rectify` rotates each camera half way (Bouguet) and keeps one image size: other pixels, and the
    figures reported so far would change. Here the plane holds all of alpha at about its own resolution, and
    beta's principal point is shifted so that disparities start at 0 whichever camera is on the left.
    """
    pose = pair.beta_from_alpha
    tensors = (*(c.K for c in pair.cameras), pose.R, pose.t)
    K_alpha, K_beta, R, t = (x.detach().cpu().double().numpy() for x in tensors)
    hw = pair.alpha.hw
    rotation = _rectifying_rotation(R, t)
    focal = (K_alpha[0, 0] + K_alpha[1, 1]) / 2
    K = np.diag([focal, focal, 1.0])
    right, bottom = hw[1] - 1, hw[0] - 1
    ends = np.array([[0, 0, 1], [right, 0, 1], [0, bottom, 1], [right, bottom, 1.0]])
    corners, z = _project(K @ rotation @ np.linalg.inv(K_alpha), ends)
    near, far = (float(d) for d in pair.depth_range)
    shift = -(rotation @ R.T @ t)[0] * focal / np.array([near * z.min(), far * z.max()])
    max_disparity, across = float(np.ptp(shift)), float(np.ptp(corners[:, 0]))
    if max_disparity > MOST_DISPARITY * across:
        raise ValueError(f"the near bound, {near:g}, means {max_disparity:.0f} pixels of disparity: raise it")
    K[:2, 2] = -corners.min(0) + [max_disparity, 0]
    sides = np.ceil(np.ptp(corners, axis=0) + np.array([max_disparity + 1, 1]))
    width, height = (int(side) for side in sides)
    if width * height > 8 * hw[0] * (hw[1] + max_disparity):
        raise ValueError(UNRECTIFIABLE)
    K_shifted = K.copy()
    K_shifted[0, 2] += shift.min()
    from_alpha = K @ rotation @ np.linalg.inv(K_alpha)
    from_beta = K_shifted @ rotation @ R.T @ np.linalg.inv(K_beta)
    return _Plane(from_alpha, from_beta, (width, height), max_disparity)


def _rectifying_rotation(R: NDArray, t: NDArray) -> NDArray[np.float64]:
    """Return the rotation from alpha's axes to x along the baseline, z near the mean of both optical axes."""
    baseline = R.T @ t
    if not np.linalg.norm(baseline) > 0:
        raise ValueError("both cameras have the same centre (t is zero): there is no depth to match")
    x = baseline / np.linalg.norm(baseline)
    y = np.cross(np.array([0, 0, 1.0]) + R[2], x)
    y /= max(np.linalg.norm(y), 1e-12)
    return np.stack([x, y, np.cross(x, y)])


def _project(H: NDArray, points: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    transformed = points @ H.T
    if (transformed[:, 2] <= 1e-6).any():
        raise ValueError(UNRECTIFIABLE)
    return transformed[:, :2] / transformed[:, 2:], transformed[:, 2]


class _Correspondence(NamedTuple):
    """Positions of `mono`'s pixels in the other image, mask of visible ones, weights of consistent ones."""

    columns: Image
    rows: Image
    seen: Image
    weight: Image


def _correspondence(
    soft: Image, other: Image, guide: NDArray[np.uint8], inside: Image, max_disparity: float
) -> _Correspondence:
    """Match `other`, luminance normalised to mono's; `inside` is 1 where it has content."""
    columns, rows = _grid(soft.shape)
    ours, consistent = checked_disparity(to_bytes(soft), to_bytes(other), max_disparity)
    diffused = filled(ours[None], consistent.astype(np.float32) + 1e-5, guide, DISPARITY_FILL)[0]
    columns = columns - np.where(consistent, ours, diffused)
    visible = _sampled(inside, columns, rows) * (columns >= -0.5)
    return _Correspondence(columns, rows, visible, np.maximum(consistent, INCONSISTENT) * visible)


def checked_disparity(
    left: NDArray[np.uint8], right: NDArray[np.uint8], max_disparity: float
) -> tuple[Image, NDArray[np.bool_]]:
    """Compute the disparity of the left image by OpenCV's semi-global matching, with a left-right check.

    Args:
        left: left rectified image (h, w).
        right: right rectified image of the same size.
        max_disparity: largest disparity, pixels, rounded up as in `raw_disparity`.

    Returns:
        Disparity (h, w) in pixels, from x in the left image to x - disparity in the right, negative where
        unknown; and a mask (h, w) of pixels that pass the check.
    """
    ours = raw_disparity(left, right, max_disparity)
    # Seen from beta, alpha's points lie to the right: mirrored, to the left again.
    theirs = raw_disparity(right[:, ::-1], left[:, ::-1], max_disparity)[:, ::-1]
    columns, rows = _grid(left.shape)
    back = _sampled(np.ascontiguousarray(theirs), columns - ours, rows, how=cv2.INTER_NEAREST)
    return ours, (np.abs(back - ours) <= CHECK) & (ours >= 0) & (columns - ours >= -0.5)


def _warped_chroma(
    mono: Image, colours: Image, inside: Image, max_disparity: float, sharpness: float
) -> Image:
    """Compute differences (R - Y, B - Y) of `colours` at `mono`'s pixels, both (h, w) on one rectified grid.

    `inside` is 1 where `colours` has content; `sharpness` is their resolution over mono's.
    """
    soft, guide = _softened(mono, sharpness), to_bytes(mono)
    match = _correspondence(soft, _normalised(_luma(colours), mono, inside), guide, inside, max_disparity)
    warped = _sampled(colours, match.columns, match.rows)
    warped_luma = _luma(warped)
    normalised = _normalised(warped_luma, mono, match.seen)
    chroma = _regressed(warped[..., [0, 2]] - warped_luma[..., None], warped_luma, mono - normalised)
    likeness = np.exp(-np.square(cv2.GaussianBlur(np.abs(soft - normalised), (0, 0), 1) / LIKENESS))
    weight = match.weight * likeness
    return _blended(chroma, weight.astype(np.float32), mono, guide)


def _warped_band(mono: Image, band: Image, inside: Image, max_disparity: float, sharpness: float) -> Image:
    """Compute the excess of `band` over `mono` at `mono`'s pixels; both (h, w) on one rectified grid."""
    soft, guide = _softened(mono, sharpness), to_bytes(mono)
    match = _correspondence(soft, _normalised(band, mono, inside), guide, inside, max_disparity)
    difference = (_sampled(band, match.columns, match.rows) - soft)[..., None]
    return _blended(difference, match.weight.astype(np.float32), mono, guide)[..., 0]


def _softened(mono: Image, sharpness: float) -> Image:
    """Return `mono` as sharp as an image of `sharpness` times its resolution enlarged to its size."""
    if sharpness >= 1:
        return mono
    height, width = (max(1, round(side * sharpness)) for side in mono.shape)
    small = cv2.resize(mono, (width, height), interpolation=cv2.INTER_AREA)
    return cv2.resize(small, mono.shape[::-1], interpolation=cv2.INTER_CUBIC)


def raw_disparity(left: NDArray[np.uint8], right: NDArray[np.uint8], max_disparity: float) -> Image:
    """Compute the disparity of a left image (h, w) by OpenCV's semi-global matching, without a check.

    The right image has the same size; disparities from 0 to `max_disparity` pixels, or to the width if that
    is less, are searched, and up to the next multiple of 16.

    Returns:
        Disparity (h, w) of the left image's pixels, in pixels; negative where unknown.
    """
    count = 16 * int(np.ceil((min(max_disparity, left.shape[1]) + 1) / 16))
    costs = {"P1": 8 * BLOCK**2, "P2": 32 * BLOCK**2, "disp12MaxDiff": 1, "preFilterCap": 31}
    matcher = cv2.StereoSGBM.create(0, count, BLOCK, **costs, uniquenessRatio=5, mode=cv2.STEREO_SGBM_MODE_HH)
    padded = (cv2.copyMakeBorder(x, 0, 0, count, count, cv2.BORDER_REPLICATE) for x in (left, right))
    return matcher.compute(*padded)[:, count:-count].astype(np.float32) / 16


def _normalised(luma: Image, mono: Image, weight: Image) -> Image:
    """Return `luma` with mono's mean and standard deviation: cameras may differ in exposure."""
    mean, deviation = _mean_and_deviation(luma, weight)
    wanted_mean, wanted_deviation = _mean_and_deviation(mono, weight)
    gain = wanted_deviation / deviation if deviation > 1e-3 else 1.0
    return ((luma - mean) * gain + wanted_mean).astype(np.float32)


def _mean_and_deviation(plane: Image, weight: Image) -> tuple[float, float]:
    total = max(float(weight.sum()), 1.0)
    mean = float((plane * weight).sum()) / total
    return mean, float((np.square(plane - mean) * weight).sum() / total) ** 0.5


def _regressed(chroma: Image, luma: Image, residual: Image) -> Image:
    """Correct chroma along its local regression on luminance (guided filter) by the detail that beta lost."""
    mean = _box(luma)
    variance: Image = _box(luma * luma) - mean * mean
    covariance = _box(chroma * luma[..., None]) - _box(chroma) * mean[..., None]
    slope = covariance / (np.maximum(variance, 0) + REGRESSION_FLOOR)[..., None]
    return chroma + slope * np.clip(residual, -0.2, 0.2)[..., None]


def _blended(values: Image, weight: Image, mono: Image, guide: NDArray[np.uint8]) -> Image:
    """Replace values (h, w, c) of low weight by those of similar and of connected pixels."""
    planes = np.ascontiguousarray(values.transpose(2, 0, 1), np.float32)
    seen = weight > SEEN
    examples = _by_examples(planes, seen, mono)
    connected = filled(planes, weight + 1e-4, guide, COLOUR_FILL)
    alike = np.where(seen, (connected + examples) / 2, examples)
    start = weight * planes + (1 - weight) * alike
    smooth = filled(start, np.where(seen, weight, UNSEEN).astype(np.float32), guide, LAST_FILL)
    share = np.where(seen, weight, 0)
    joined = share * start + (1 - share) * smooth
    return np.ascontiguousarray(joined.transpose(1, 2, 0), np.float32)


def _by_examples(values: Image, seen: NDArray[np.bool_], mono: Image) -> Image:
    """Replace unseen values (c, h, w) by the mean of the seen ones nearest in luminance, texture and place.

    Not `pat.matching.colour_transfer`, on purpose: the fusion's baseline shares none of its stages.
    """
    columns, rows = _grid(mono.shape)
    texture = [np.sqrt(np.maximum(_mean(mono * mono, r) - _mean(mono, r) ** 2, 0)) for r in (2, 6)]
    what = [mono * 12, _mean(mono, 2) * 10, _mean(mono, 6) * 5, texture[0] * 12, texture[1] * 8]
    features = np.stack([*what, rows / 90, columns / 140], -1)
    sources, asked, out = np.zeros_like(seen), ~seen, values.copy()
    sources[::2, ::2] = seen[::2, ::2]
    if sources.sum() < EXAMPLES or not asked.any():
        return out
    index, distance = nearest_points(features[sources], features[asked], EXAMPLES)
    weight = np.exp(-np.square(distance / (distance[:, :1] + 0.15)))
    out[:, asked] = (values[:, sources][:, index] * weight).sum(-1) / weight.sum(-1)
    return out


def _mean(plane: Image, radius: int) -> Image:
    return cv2.boxFilter(plane, -1, (2 * radius + 1,) * 2)


def _recoloured(alpha: Float[Tensor, "1 h w"], chroma: Image) -> Float[Tensor, "3 h w"]:
    planes = torch.from_numpy(np.ascontiguousarray(chroma.transpose(2, 0, 1)))
    return from_luma_chroma(alpha, planes.to(alpha)).clamp(0, 1)


def _planes(image: Float[Tensor, "c h w"]) -> Image:
    """Return an image as (H, W, C) for OpenCV."""
    return np.ascontiguousarray(image.detach().cpu().float().numpy().transpose(1, 2, 0))


def _luma(colours: Image) -> Image:
    return luminance(torch.from_numpy(colours).permute(2, 0, 1))[0].numpy()


def _grid(shape: tuple[int, ...]) -> tuple[Image, Image]:
    rows, columns = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    return columns, rows


def _sampled(image: Image, columns: Image, rows: Image, how: int = cv2.INTER_CUBIC) -> Image:
    return cv2.remap(image, columns, rows, how, borderMode=cv2.BORDER_REPLICATE)


def _warped(image: Image, H: NDArray, wh: tuple[int, int]) -> Image:
    """Warp an image by x' ~ H x; its border is repeated beyond."""
    return cv2.warpPerspective(image, H, wh, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def _box(planes: Image) -> Image:
    return cv2.boxFilter(planes, -1, (2 * REGRESSION_RADIUS + 1,) * 2, borderType=cv2.BORDER_REFLECT)
