"""Noise removed from groups of similar blocks, like BM3D (Dabov et al. 2007), from a network's estimate.

Blocks of 8 x 8 pixels are stacked with the most similar ones near them. A cosine transform of each and a
Hadamard transform over the stack gather their common content in few coefficients, and noise spreads over all
of them. Coefficients are weighted by their strength in an earlier estimate (Wiener's filter). Another
camera's recording of the same points is added likewise (`other_camera_update`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad, unfold

from arraygeom.runtime.chunks import spans
from arraygeom.runtime.compiled import compiled
from arraygeom.runtime.threads import in_parallel

from ..support.settings import size, tuned
from .denoiser import opponent, opponent_deviation, rgb_of_opponent


@dataclass(frozen=True)
class BM3DSettings:
    """Settings of the filter of groups of similar blocks, BM3D (Dabov et al. 2007).

    The filter reads those in `SETTINGS`, once, when it is imported. `pat lab settings` prints the value of
    each with its meaning and reason.
    """

    side: int = size(8, "Side of a block, pixels")
    step: int = size(4, "Steps between blocks, pixels")
    alike: int = size(16, "Blocks in a group")
    radius: int = size(16, "How far away alike blocks are looked for, pixels")
    rows: int = size(16, "Rows of blocks that a thread works on at once")
    as_recorded: float = tuned(
        0.5,
        "Middlebury, tune half: alike blocks are looked for in an estimate with so much of the noise left: "
        "where an image is flat the noise makes blocks alike that lie apart, as is needed",
    )
    kept: float = tuned(0.5, "Middlebury, tune half: share of the network's brightness that is kept")
    unlike: float = tuned(
        0.05, "Middlebury, tune half: share of a coefficient's power by which another camera's match differs"
    )
    blocks: int = size(20_000, "About so many blocks say how another camera blurs")


SETTINGS = BM3DSettings()
SIDE, STEP, ALIKE, RADIUS, ROWS = SETTINGS.side, SETTINGS.step, SETTINGS.alike, SETTINGS.radius, SETTINGS.rows
"""Settings as constants for the compiled loops, which read no attributes."""
AS_RECORDED, KEPT, UNLIKE = SETTINGS.as_recorded, SETTINGS.kept, SETTINGS.unlike
CELLS = SIDE // STEP


def without_noise(
    network: Callable[..., Tensor], recorded: Float[Tensor, "b c h w"], deviation: Float[Tensor, "b c h w"]
) -> Float[Tensor, "b c h w"]:
    """Denoise images of one band or of three (RGB) by a denoiser of `LowLightNetwork`, and refine its result.

    Args:
        network: denoiser, called with the images and the deviations, both (b, c, h, w).
        recorded: noisy images, values 0..1; one at least.
        deviation: standard deviation of each value's noise.

    Returns:
        The denoised images, as `refined`, which raises the same.
    """
    return refined(network(recorded, deviation), recorded, deviation)


def refined(
    estimate: Float[Tensor, "b c h w"],
    recorded: Float[Tensor, "b c h w"],
    deviation: Float[Tensor, "b c h w"],
) -> Float[Tensor, "b c h w"]:
    """Refine a network's estimate of images of one band or of three (RGB) that were recorded with noise.

    A single band is filtered once, RGB twice; then the band, or RGB's brightness, is averaged with the
    network's (share `kept`).

    Args:
        estimate: the network's images without noise; one at least, all values finite.
        recorded: the noisy images, values 0..1.
        deviation: standard deviation of each value's white noise.

    Returns:
        Images of the same shape, not clipped. A gradient reaches the estimate only, through that share.

    Raises:
        RuntimeError: by torch, for two bands or more than three.
    """
    return torch.stack([_refined(*parts) for parts in zip(estimate, recorded, deviation)])


def _refined(estimate: Tensor, recorded: Tensor, deviation: Tensor) -> Float[Tensor, "c h w"]:
    if len(estimate) == 1:
        return torch.lerp(_filtered(recorded, estimate, deviation), estimate, KEPT)
    bands, noise = opponent(recorded[None])[0], opponent_deviation(deviation[None])[0]
    transformed = opponent(estimate[None])[0]
    result = _filtered(bands, _filtered(bands, transformed, noise), noise)
    result = torch.cat([torch.lerp(result[:1], transformed[:1], KEPT), result[1:]])
    return rgb_of_opponent(result[None])[0]


def _filtered(recorded: Tensor, expected: Tensor, deviation: Tensor) -> Float[Tensor, "c h w"]:
    """Filter by Wiener's filter; blocks are similar by the first band."""
    return wiener_filtered(recorded, expected, deviation, torch.lerp(expected[:1], recorded[:1], AS_RECORDED))


def wiener_filtered(
    image: Float[Tensor, "c h w"],
    expected: Float[Tensor, "c h w"],
    deviation: Float[Tensor, "c h w"],
    guide: Float[Tensor, "g h w"],
) -> Float[Tensor, "c h w"]:
    """Remove white noise from an image, each band separately, by Wiener's filter of groups of similar blocks.

    Beyond the edges images are mirrored. Computed in float32 on the CPU, on as many threads as torch may use.

    Args:
        image: noisy image of any bands. All values must be finite.
        expected: estimate of the image without noise.
        deviation: standard deviation of each value's noise.
        guide: image in which blocks are compared, of any bands and the same size.

    Returns:
        The filtered image (c, h, w) in the image's type and on its device, not clipped, detached.
    """
    return _of_groups(filter_groups, [image, expected, deviation.square()], guide, len(image))


class Observation(NamedTuple):
    """Another camera's recording of the same band, resampled to an image's pixels: planes (1, h, w).

    Attributes:
        recorded: recorded values.
        deviation: standard deviation of their noise.
        grain: a sample of noise of unit deviation, white in that camera, resampled as the values were.
        confidence: confidence of the positions, 0 to 1.
    """

    recorded: Tensor
    deviation: Tensor
    grain: Tensor
    confidence: Tensor


def other_camera_update(
    estimate: Float[Tensor, "1 h w"],
    recorded: Float[Tensor, "1 h w"],
    deviation: Float[Tensor, "1 h w"],
    other: Observation,
) -> Float[Tensor, "1 h w"]:
    """Compute the update of an estimate without noise by another camera's recording of the same points.

    Kalman's update (1960) of each group's coefficients. The estimate's error is taken to be that of Wiener's
    filter. The blur of the other camera is estimated, as is its noise's spectrum from its grain; the less
    certain its positions are, the less it counts.

    Args:
        estimate: image without noise.
        recorded: noisy image from which the estimate was made.
        deviation: standard deviation of the noise of `recorded`.
        other: the other camera's recording; values must be finite where its confidence is 0, too.

    Returns:
        Values (1, h, w) to add to the estimate, detached.
    """
    taken = torch.lerp(estimate, other.recorded, other.confidence)
    planes = [estimate, taken, deviation.square(), other.deviation.square(), other.confidence]
    update = partial(update_groups, *_blur_and_spectrum(estimate, other))
    return _of_groups(update, planes, torch.lerp(estimate, recorded, AS_RECORDED), 1)


def _blur_and_spectrum(estimate: Float[Tensor, "1 h w"], other: Observation) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the share of each block coefficient that another camera shows, and its grain's power."""
    step = max(round((estimate.numel() / SETTINGS.blocks) ** 0.5), 1)
    planes = torch.stack([estimate, *other[:1], *other[2:]]).float()
    size = [max(SIDE - n, 0) for n in reversed(estimate.shape[-2:])]
    planes = pad(planes, (0, size[0], 0, size[1]), mode="replicate")
    blocks = unfold(planes, SIDE, stride=step).mT.unflatten(-1, (SIDE, SIDE))
    cosines = torch.from_numpy(COSINES).to(blocks)
    own, seen, grain = (cosines @ blocks[:3] @ cosines.T).flatten(2)
    counts = blocks[3].mean((-2, -1)).square().clamp(min=1e-9)
    share = (counts @ (own * seen)) / (counts @ own.square()).clamp(min=1e-9)
    spectrum = (counts @ grain.square()) / counts.sum()
    return share.clamp(0, 1).cpu().numpy(), spectrum.cpu().numpy()


def _of_groups(
    kernel: Callable[..., None], images: Sequence[Tensor], guide: Float[Tensor, "g h w"], bands: int
) -> Float[Tensor, "bands h w"]:
    """Apply a kernel to the groups of blocks that are similar in the guide, and blend the results."""
    h, w = guide.shape[-2:]
    margin = SIDE - STEP
    across, down = (-(-(size + margin) // STEP) for size in (w, h))
    first = RADIUS + margin
    padding = [(0, 0), (first, STEP * down + first - h), (first, STEP * across + first - w)]
    *planes, alike_in = (
        np.pad(x.detach().float().cpu().numpy(), padding, mode="symmetric") for x in (*images, guide)
    )
    high = STEP * (ROWS - 1) + SIDE + 2 * RADIUS

    def filtered(top: int, bottom: int) -> np.ndarray:
        alike = np.zeros((bottom - top, across, ALIKE, 2), np.int16)
        find_alike(alike_in, top, alike)
        sums = np.zeros((2, bands, high, alike_in.shape[2]), np.float32)
        kernel(*planes, top, alike, COSINES, WINDOW, sums)
        return sums

    total = np.zeros((2, bands, *alike_in.shape[1:]), np.float32)
    strips: dict[int, np.ndarray] = {}
    in_parallel([lambda span=span: strips.update({span[0]: filtered(*span)}) for span in spans(down, ROWS)])
    for top in sorted(strips):
        rows = total[:, :, STEP * top : STEP * top + high]
        rows += strips.pop(top)[:, :, : rows.shape[2]]
    inside = total[:, :, first : first + h, first : first + w]
    return torch.from_numpy(inside[0] / inside[1]).to(images[0])


_PHASES = np.outer(np.arange(SIDE), 2 * np.arange(SIDE) + 1) * np.pi / (2 * SIDE)
_LENGTHS = np.where(np.arange(SIDE) > 0, 2, 1)[:, None] ** 0.5
COSINES = (np.cos(_PHASES) * _LENGTHS / SIDE**0.5).astype(np.float32)
"""The cosine transform (DCT-II) as an orthogonal matrix; SciPy's would add to the time of every start."""
WINDOW = np.outer(np.kaiser(SIDE, 2.0), np.kaiser(SIDE, 2.0)).astype(np.float32)
"""Weights of a block's pixels when blocks are blended."""


@compiled(nogil=True, cache=True, fastmath=True)
def find_alike(guide, top, alike):
    """Find the blocks within RADIUS pixels most similar to each reference block, by the sum of squared
    differences.

    Args:
        guide: image (bands, h, w), float32, in which blocks are compared, with RADIUS pixels around them all.
        top: number of the first row of reference blocks.
        alike: displacements (y, x) to write, integers (rows, columns, ALIKE, 2), the most similar first, for
            reference block (r, k), which begins at row RADIUS + STEP (top + r) and column RADIUS + STEP k; it
            is the first of its own group.
    """
    rows, columns = alike.shape[:2]
    cells = np.zeros((rows + CELLS - 1, columns + CELLS - 1), np.float32)
    line = np.zeros(STEP * cells.shape[1], np.float32)
    nearest = np.full((rows, columns, ALIKE), np.inf, np.float32)
    for dy in range(-RADIUS, RADIUS + 1):
        for dx in range(-RADIUS, RADIUS + 1):
            for r in range(len(cells)):
                line[:] = 0
                for c in range(len(guide)):
                    for y in range(RADIUS + STEP * (top + r), RADIUS + STEP * (top + r + 1)):
                        guide_row = guide[c, y, RADIUS : RADIUS + len(line)]
                        shifted_row = guide[c, y + dy, RADIUS + dx : RADIUS + dx + len(line)]
                        for x in range(len(line)):
                            line[x] += (shifted_row[x] - guide_row[x]) ** 2
                for k in range(cells.shape[1]):
                    cells[r, k] = line[4 * k] + line[4 * k + 1] + line[4 * k + 2] + line[4 * k + 3]
            for r in range(rows):
                for k in range(columns):
                    d = cells[r, k] + cells[r, k + 1] + cells[r + 1, k] + cells[r + 1, k + 1]
                    if dy == 0 and dx == 0:
                        d = np.float32(-1)
                    if d < nearest[r, k, ALIKE - 1]:
                        i = ALIKE - 1
                        while i > 0 and nearest[r, k, i - 1] > d:
                            nearest[r, k, i] = nearest[r, k, i - 1]
                            alike[r, k, i] = alike[r, k, i - 1]
                            i -= 1
                        nearest[r, k, i] = d
                        alike[r, k, i, 0] = dy
                        alike[r, k, i, 1] = dx


@compiled(inline="always")
def block_transform(blocks, spare, matrix):
    """Transform every block B of a group to M B M^T, in place.

    Args:
        blocks: pixels of the blocks (SIDE^2, ALIKE), float32, the block's number last.
        spare: scratch of the same shape, overwritten.
        matrix: M (SIDE, SIDE).
    """
    for u in range(SIDE):
        for j in range(SIDE):
            for n in range(ALIKE):
                total = np.float32(0)
                for i in range(SIDE):
                    total += matrix[u, i] * blocks[SIDE * i + j, n]
                spare[SIDE * u + j, n] = total
    for u in range(SIDE):
        for v in range(SIDE):
            for n in range(ALIKE):
                total = np.float32(0)
                for j in range(SIDE):
                    total += matrix[v, j] * spare[SIDE * u + j, n]
                blocks[SIDE * u + v, n] = total


@compiled(inline="always")
def group_transform(blocks):
    """Apply the orthonormal Hadamard transform across a group's blocks, in place; it is its own inverse.

    Args:
        blocks: coefficients (SIDE^2, ALIKE), float32, the block's number last.
    """
    for i in range(SIDE * SIDE):
        width = 1
        while width < ALIKE:
            for start in range(0, ALIKE, 2 * width):
                for n in range(start, start + width):
                    a, b = blocks[i, n], blocks[i, n + width]
                    blocks[i, n], blocks[i, n + width] = a + b, a - b
            width *= 2
        for n in range(ALIKE):
            blocks[i, n] *= np.float32(ALIKE**-0.5)


@compiled(inline="always")
def read_group(plane, y0, x0, alike, matrix, spare, group):
    """Fill a group with the transformed blocks of a plane."""
    for n in range(ALIKE):
        y, x = y0 + alike[n, 0], x0 + alike[n, 1]
        for i in range(SIDE):
            for j in range(SIDE):
                group[SIDE * i + j, n] = plane[y + i, x + j]
    block_transform(group, spare, matrix)
    group_transform(group)


@compiled(inline="always")
def mean_of_group(plane, y0, x0, alike):
    """Return the mean of a plane in the middles of a group's blocks."""
    mean = np.float32(1e-12)
    for n in range(ALIKE):
        mean += plane[y0 + alike[n, 0] + SIDE // 2, x0 + alike[n, 1] + SIDE // 2] / ALIKE
    return mean


@compiled(inline="always")
def accumulate(group, counts, y0, x0, alike, window, out):
    """Add to `out` (2, rows, w) a group's blocks with a weight, and the weights."""
    for n in range(ALIKE):
        y, x = y0 + alike[n, 0], x0 + alike[n, 1]
        for i in range(SIDE):
            for j in range(SIDE):
                weight = counts * window[i, j]
                out[0, y + i, x + j] += weight * group[SIDE * i + j, n]
                out[1, y + i, x + j] += weight


@compiled(nogil=True, cache=True, fastmath=True)
def filter_groups(image, expected, variance, top, alike, cosines, window, out):
    """Filter groups of similar blocks by Wiener's filter, and add up the blocks and their weights.

    Args:
        image: noisy planes (c, h, w), float32, padded as the guide of `find_alike`.
        expected: the same without noise, approximately.
        variance: variance of the noise, of the same shape.
        top: number of the first row of reference blocks.
        alike: displacements of each group's blocks, as `find_alike` writes them.
        cosines: orthogonal cosine transform (SIDE, SIDE).
        window: weights of a block's pixels (SIDE, SIDE).
        out: sums (2, c, rows, w) to add to: weighted blocks, and weights; row 0 is row STEP top of `image`.
    """
    rows, columns = alike.shape[:2]
    group = np.empty((SIDE * SIDE, ALIKE), np.float32)
    pilot = np.empty((SIDE * SIDE, ALIKE), np.float32)
    spare = np.empty((SIDE * SIDE, ALIKE), np.float32)
    back = cosines.T.copy()
    for r in range(rows):
        for k in range(columns):
            y0, x0 = RADIUS + STEP * (top + r), RADIUS + STEP * k
            for c in range(len(image)):
                noise = mean_of_group(variance[c], y0, x0, alike[r, k])
                read_group(image[c], y0, x0, alike[r, k], cosines, spare, group)
                read_group(expected[c], y0, x0, alike[r, k], cosines, spare, pilot)
                total = np.float32(1)
                for i in range(SIDE * SIDE):
                    for n in range(ALIKE):
                        power = pilot[i, n] * pilot[i, n]
                        share = power / (power + noise)
                        group[i, n] *= share
                        total += share * share
                group_transform(group)
                block_transform(group, spare, back)
                counts = 1 / ((noise + np.float32(1e-8)) * total)
                accumulate(group, counts, y0 - STEP * top, x0, alike[r, k], window, out[:, c])


@compiled(nogil=True, cache=True, fastmath=True)
def update_groups(
    share, spectrum, estimate, taken, variance, other, confidence, top, alike, cosines, window, out
):
    """Compute Kalman updates of groups of similar blocks, and add up the updates and their weights.

    Args:
        share: share of each coefficient (SIDE^2) that the other camera's blur leaves.
        spectrum: power of each coefficient (SIDE^2) of the other camera's noise of unit deviation.
        estimate: image without noise (1, h, w), float32, padded as the guide of `find_alike`; as are the next
            four.
        taken: the other camera's values; the estimate's where positions are not certain.
        variance: variance of the noise from which the estimate was made.
        other: variance of the other camera's noise.
        confidence: confidence of the positions, 0 to 1.
        top: number of the first row of reference blocks.
        alike: displacements of each group's blocks, as `find_alike` writes them.
        cosines: orthogonal cosine transform (SIDE, SIDE).
        window: weights of a block's pixels (SIDE, SIDE).
        out: sums (2, 1, rows, w) to add to: weighted updates, and weights; row 0 is row STEP top of
            `estimate`.
    """
    rows, columns = alike.shape[:2]
    group = np.empty((SIDE * SIDE, ALIKE), np.float32)
    pilot = np.empty((SIDE * SIDE, ALIKE), np.float32)
    spare = np.empty((SIDE * SIDE, ALIKE), np.float32)
    back = cosines.T.copy()
    for r in range(rows):
        for k in range(columns):
            y0, x0 = RADIUS + STEP * (top + r), RADIUS + STEP * k
            noise = mean_of_group(variance[0], y0, x0, alike[r, k])
            others = mean_of_group(other[0], y0, x0, alike[r, k])
            certain = mean_of_group(confidence[0], y0, x0, alike[r, k]) + np.float32(1e-6)
            read_group(taken[0], y0, x0, alike[r, k], cosines, spare, group)
            read_group(estimate[0], y0, x0, alike[r, k], cosines, spare, pilot)
            total = np.float32(1)
            for i in range(SIDE * SIDE):
                for n in range(ALIKE):
                    power = pilot[i, n] * pilot[i, n]
                    error = power * noise / (power + noise)
                    unlike = (spectrum[i] * others + UNLIKE * power) / (certain * certain)
                    gain = share[i] * error / (share[i] * share[i] * error + unlike + np.float32(1e-12))
                    group[i, n] = gain * (group[i, n] - share[i] * pilot[i, n])
                    total += gain * gain
            group_transform(group)
            block_transform(group, spare, back)
            accumulate(group, 1 / total, y0 - STEP * top, x0, alike[r, k], window, out[:, 0])
