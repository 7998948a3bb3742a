"""Pairs with exact matches: what the features for matching learn from.

Layered scenes of random rigs, and windows of stereo pairs with true disparity; both recorded with another
response, exposure, gamma, vignetting, blur, resolution, noise and compression in each view. Sample n is a
function of the seed and n alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d

from arraygeom import Epipolar, Segments
from arraygeom.fields.grid import FieldOnGrid
from experiments.evaluation.conditions import regions_of
from experiments.evaluation.halves import of_half
from pat.data.pairs import StereoPair, middlebury_pairs
from pat.matching.normalisation import Normalisation
from pat.matching.positions import Extent
from pat.media.colour import REC601
from pat.sensors import GaussianBlur, NoiseLevel, generator_for, record
from pat.synthesis.layered import ArrayBatch, LayeredScenes
from pat.synthesis.photos import PhotoBank
from pat.synthesis.rigs import below, one_of, uniform
from pat.training.config import GENERAL, RECTIFIED
from pat.training.samples import enlarged, pair_of, transfer

REUSED = 3
"""How many times a scene is recorded on average."""
FOUR = 4
"""Scenes that the samples of so many steps times `REUSED` are of."""
RATES = (1, 2, 2, 2, 4, 4, 8)
"""How many times beta is reduced, drawn evenly."""


class TrueMatches(NamedTuple):
    """Where alpha's pixels are along their segments, (B, h, w).

    end, along: (B, h, w, 2), a segment's far end and the direction to its near end, pixels of beta.
    length: its length, pixels; negative where there is none.
    label: the true position, pixels from the end.
    seen: whether beta sees the point; known: whether that and the position are known.
    """

    end: Tensor
    along: Tensor
    length: Tensor
    label: Tensor
    seen: Tensor
    known: Tensor

    def halved(self) -> TrueMatches:
        """Those of images at half the size, where the four pixels are of one surface."""
        start = self.end + self.along * self.length[..., None]
        middle = (_of_four(x.movedim(-1, 1)).mean(-1).movedim(1, -1) for x in (self.end, start))
        end, start = ((x + 0.5) / 2 - 0.5 for x in middle)
        four, seen = _of_four(self.label), _of_four(self.seen)
        length = (start - end).norm(dim=-1)
        near = (four.amax(-1) - four.amin(-1) < 1.5) & (seen.all(-1) == seen.any(-1))
        valid = (_of_four(self.length) >= 0).all(-1)
        return TrueMatches(
            end,
            (start - end) / length.clamp(min=1e-6)[..., None],
            torch.where(valid, length, -1.0),
            four.mean(-1) / 2,
            seen.all(-1),
            _of_four(self.known).all(-1) & near,
        )


class Normalised(NamedTuple):
    """Alpha and beta's brightness (B, 1, H, W), brought to one level and sharpness as before matching, and by
    how much the sharper one was blurred (B), pixels."""

    alpha: Tensor
    beta: Tensor
    blur: Tensor


class MatchingSample(NamedTuple):
    """Both views at full size and at half of it, and the true matches at full size."""

    full: Normalised
    half: Normalised
    matches: TrueMatches


class ColourPair(NamedTuple):
    """Two views (B, 3, H, W) before they are recorded, and their true matches."""

    alpha: Tensor
    beta: Tensor
    matches: TrueMatches


@dataclass(frozen=True)
class MatchingRecording:
    """Probabilities of what differs between two views' recordings."""

    response: float = 0.6
    gain: float = 0.4
    gamma: float = 0.3
    vignetting: float = 0.1
    blur: float = 0.2
    noise: float = 0.3
    jpeg: float = 0.15
    misaligned: float = 0.5


class MatchingScenes:
    """Colour pairs by number, `batch` each: layered ones, and windows of pairs as often as `pairs` says."""

    def __init__(
        self,
        bank: PhotoBank,
        stereo: Sequence[StereoPair],
        *,
        hw: tuple[int, int],
        batch: int,
        pairs: float,
        seed: int,
    ) -> None:
        rigs = (replace(RECTIFIED, resolutions=(1.0,)), replace(GENERAL, resolutions=(1.0,)))
        self.makers = [LayeredScenes(bank, rig, hw=hw, seed=seed) for rig in rigs]
        self.stereo, self.hw, self.batch, self.pairs, self.seed = list(stereo), hw, batch, pairs, seed
        self.made: Callable[[int], ColourPair] = lru_cache(2 * FOUR)(self._made)

    def of_step(self, step: int) -> ColourPair:
        """What step `step` records: one of `FOUR` scenes, for `REUSED` times as many steps."""
        drawn = below(FOUR, generator_for(self.seed, "choice", step))
        return self.made(step // (FOUR * REUSED) * FOUR + drawn)

    def _made(self, number: int) -> ColourPair:
        g = generator_for(self.seed, "scene", number)
        if self.stereo and float(torch.rand((), generator=g)) < self.pairs:
            return _joined([window_of(one_of(self.stereo, g), self.hw, g) for _ in range(self.batch)])
        return layered_pair(one_of(self.makers, g).sample(self.batch, g), g)


def tune_stereo(folder: Path, aside: Sequence[str], *, kept_aside: bool = False) -> list[StereoPair]:
    """Middlebury's tune pairs with true disparity: without names ending in one of `aside`, or these alone."""
    pairs = of_half(middlebury_pairs(folder), "tune")
    return [pair for pair in pairs if pair.name.endswith(tuple(aside)) == kept_aside]


def layered_pair(scene: ArrayBatch, g: Generator) -> ColourPair:
    """The two views of a layered scene, with the matches that its planes give."""
    pair = pair_of(scene, 1, g)
    position, seen = transfer(pair, scene.depth[0], scene.depth[1])
    segments = FieldOnGrid.of(Epipolar(), pair).straight
    return ColourPair(scene.images[0], scene.images[1], along_segments(segments, position, seen))


def along_segments(
    segments: Segments,
    position: Float[Tensor, "b h w 2"],
    seen: Bool[Tensor, "b h w"],
) -> TrueMatches:
    """True positions in beta as labels along the segments."""
    length, along = Extent.of(segments)
    label = ((position - segments.end) * along).sum(-1)
    length, known = torch.where(segments.valid, length, -1.0), segments.valid & position.isfinite().all(-1)
    b = len(position)
    parts = (segments.end.float(), along.float(), length.float(), label.float(), seen, known)
    return TrueMatches(*(x.expand(b, *x.shape[1:]) for x in parts))


def window_of(pair: StereoPair, hw: tuple[int, int], g: Generator) -> ColourPair:
    """A window of a rectified pair, upside down and mirrored at random."""
    assert pair.disparity is not None
    h, w = hw
    full = pair.left.shape[-2:]
    top, left = (below(max(n - m, 0) + 1, g) for n, m in zip(full, hw))
    part = (..., slice(top, top + h), slice(left, left + w))
    value, valid = pair.disparity.value[part], pair.disparity.valid[part]
    column = torch.arange(value.shape[-1]).expand_as(value)
    seen = regions_of(pair, (full[0], full[1]))["seen"][part] & (column - value >= 0)
    alpha, beta = (image[part][None] for image in (pair.left, pair.right))
    row = torch.arange(value.shape[-2])[:, None].expand_as(value)
    end = torch.stack([column, row], -1).float()
    along = torch.tensor([-1.0, 0.0]).expand_as(end)
    longest = float(uniform((1.0, 1.4), (), g)) * float(value[valid].max() if valid.any() else 1.0)
    length = (column + 0.49).clamp(max=longest)
    found = TrueMatches(*(x[None] for x in (end, along, length, value, seen, valid)))
    return _mirrored(ColourPair(alpha, beta, found), *torch.randint(2, (2,), generator=g).tolist())


def _mirrored(given: ColourPair, across: int, down: int) -> ColourPair:
    """The same with columns, and with rows, in the opposite order."""
    h, w = given.alpha.shape[-2:]
    sides = [side for side, flip in ((-1, across), (-2, down)) if flip]
    sign = torch.tensor([1 - 2.0 * across, 1 - 2.0 * down])
    origin = torch.tensor([across * (w - 1.0), down * (h - 1.0)])
    end, along, *rest = given.matches
    vectors = (x.flip([side - 1 for side in sides]) for x in (end * sign + origin, along * sign))
    found = TrueMatches(*vectors, *(x.flip(sides) for x in rest))
    return ColourPair(given.alpha.flip(sides), given.beta.flip(sides), found)


def recorded_sample(given: ColourPair, g: Generator, recording: MatchingRecording) -> MatchingSample:
    """Both views recorded, brought to one brightness and sharpness as before matching."""
    alpha, guide = _bands(given, g, recording)
    alpha, guide = _recorded(alpha, g, recording, 1), _recorded(guide, g, recording, one_of(RATES, g))
    off = 0.3 * torch.randn(len(alpha), 1, 1, 2, generator=g) * _chance(recording.misaligned, g)
    moved = given.matches._replace(end=given.matches.end + off)
    half = normalised(avg_pool2d(alpha, 2), avg_pool2d(guide, 2))
    return MatchingSample(normalised(alpha, guide), half, moved)


def normalised(alpha: Tensor, guide: Tensor) -> Normalised:
    """Each of a batch of pairs with its own normalisation."""
    levels = Normalisation.of(alpha, guide)
    blur = torch.tensor(levels.blurs).amax(0)
    return Normalised(*levels.equally_sharp(alpha, levels.normalised(guide)), blur)


def _bands(given: ColourPair, g: Generator, recording: MatchingRecording) -> tuple[Tensor, Tensor]:
    """The brightness that each camera has: that of Rec. 601, or on the way from there to random weights."""

    def weights(most: float) -> Tensor:
        drawn = -torch.rand(3, generator=g).log()
        return torch.lerp(torch.tensor(REC601), drawn / drawn.sum(), most * torch.rand((), generator=g))

    most = 1.0 * _chance(recording.response, g)
    views = zip((given.alpha, given.beta), (most, most * _chance(0.3, g)))
    alpha, guide = ((image * weights(m)[:, None, None]).sum(1, keepdim=True) for image, m in views)
    return alpha, guide


def _recorded(image: Tensor, g: Generator, recording: MatchingRecording, rate: int) -> Tensor:
    """One view's brightness (B, 1, H, W) as its camera records it, enlarged again if it is reduced."""
    hw = image.shape[-2], image.shape[-1]
    if _chance(recording.gamma, g):
        image = image.clamp(0, 1) ** float((0.25 * torch.randn((), generator=g)).exp())
    if _chance(recording.gain, g):
        image = image * float((0.25 * torch.randn((), generator=g)).exp())
    if _chance(recording.vignetting, g):
        image = image * _vignetting(image, 0.5 * float(torch.rand((), generator=g)))
    if _chance(recording.blur, g):
        image = record(image, [GaussianBlur(0.4 + 1.1 * float(torch.rand((), generator=g)))], g)
    image = avg_pool2d(image, rate).clamp(0, 1)
    if _chance(recording.noise, g):
        electrons = 10 ** (2.0 + 2.2 * float(torch.rand((), generator=g)))
        image = NoiseLevel.of_electrons(electrons, 2.0).recorded(image, g)
    image = (image * 255).round() / 255
    if _chance(recording.jpeg, g):
        image = _compressed(image, 60 + below(36, g))
    return enlarged(image, hw)


def _vignetting(image: Tensor, most: float) -> Tensor:
    """What is left of the light, by up to `most` less in the corners."""
    h, w = image.shape[-2:]
    y, x = torch.linspace(-1, 1, h)[:, None], torch.linspace(-1, 1, w)
    return 1 - most * (x * x + y * y) / 2


def _compressed(image: Tensor, quality: int) -> Tensor:
    """As JPEG files of this quality have it."""
    planes = (image[:, 0] * 255).round().byte().numpy()
    files = (cv2.imencode(".jpg", plane, [cv2.IMWRITE_JPEG_QUALITY, quality])[1] for plane in planes)
    found = np.stack([cv2.imdecode(file, cv2.IMREAD_GRAYSCALE) for file in files])
    return torch.from_numpy(found)[:, None].to(image) / 255


def _of_four(x: Tensor) -> Tensor:
    """The last two axes' blocks of 2 x 2, as a last axis of four."""
    h, w = (n // 2 for n in x.shape[-2:])
    return x.unflatten(-2, (h, 2)).unflatten(-1, (w, 2)).movedim(-3, -2).flatten(-2)


def _joined(pairs: Sequence[ColourPair]) -> ColourPair:
    alpha, beta, found = zip(*pairs)
    return ColourPair(torch.cat(alpha), torch.cat(beta), TrueMatches(*(torch.cat(x) for x in zip(*found))))


def _chance(p: float, g: Generator) -> bool:
    return bool(torch.rand((), generator=g) < p)
