"""Sequences: every frame of alpha in the colours of betas with clocks of their own.

Colour is fused at key frames, those of alpha nearest in time to a beta's frame, where each beta is searched
where the points of alpha were at its own time (`Moved`), with a margin for the uncertainty of that
(`Widened`). From the key frames before and after, it is warped to each frame along the motion between alpha's
own frames, and mixed by time, confidence, and the weight of the motion. So colour does not flicker from frame
to frame as single fusions do, and a frame depends on nothing but images: any one can be computed alone, in
any order, with the same result.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Moved, ReceptiveField, Rig, Widened
from arraygeom.checks import check_above
from arraygeom.fields.default import straight_field

from ..matching.band_mix import Response
from ..matching.normalisation import UNLIKE, Moments, mean_moments
from ..networks.protocol import FusionNetwork
from ..sensors import NoiseLevel
from ..support.settings import physics, size
from .corrections import Corrections
from .frame import Frame
from .frames import CachedFrames, Frames
from .fuse import FuseSettings, corrections_of, fuse_frame, of_kind
from .low_light import noise_levels
from .optical_flow import flow_between, warped
from .steps import with_own_levels
from .timeline import KeyFrame, Timeline
from .views import grey_alpha

T = TypeVar("T")


LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class SequenceSettings:
    """Settings of sequences of cameras that record at different times.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    synchronous: float = physics(0.05, "Gaps shorter than this part of alpha's frame time count as none")
    unknown_motion: float = physics(
        0.25, "The part of the motion in a gap that fields leave room for if no speed is given"
    )
    intervals: float = size(2.0, "Colour is warped from key frames up to this many intervals of theirs away")
    neighbours: int = size(4, "Radiometry is normalised over this many key frames before and after")
    floor: float = size(1e-3, "The confidence that every source has at least when colours are mixed")


SETTINGS = SequenceSettings()


class KeyColour(NamedTuple):
    """Colour of a key frame, to be warped to the frames around it.

    Attributes:
        added: values that fusion adds to alpha, (C, H, W).
        confidence: confidence of these, 0 to 1, (H, W).
        inverse_depth: inverse depth and the half-width of its interval, one over the rig's unit, (2, H, W); 0
            where unknown.
    """

    added: Float[Tensor, "c h w"]
    confidence: Float[Tensor, "h w"]
    inverse_depth: Float[Tensor, "2 h w"]


@dataclass(frozen=True)
class SequenceFusion:
    """Fusion of a sequence of cameras that record at different times.

    `colour` fuses a key frame of alpha with betas; `frame` warps the colours of key frames to any frame.

    Attributes:
        network: network that fuses key frames.
        rig: cameras with `frame_rate` and `time_offset`.
        frames: frames by camera name, in the order of time; kept as `CachedFrames`.
        alpha: camera whose frames are wanted.
        speed: largest speed of motion, pixels of alpha a second; None for a quarter of the motion seen.
        settings: settings of fusion.

    Raises:
        ValueError: for a negative or infinite speed; the rest is checked when it is used.
        TypeError: for a speed that is no number, and settings of another type.
    """

    network: FusionNetwork
    rig: Rig
    frames: Mapping[str, Frames]
    alpha: str
    speed: float | None = None
    settings: FuseSettings = FuseSettings()

    def __post_init__(self) -> None:
        check_above(0, speed=self.speed)
        of_kind(FuseSettings, self.settings)
        cached = {n: f if isinstance(f, CachedFrames) else CachedFrames(f) for n, f in self.frames.items()}
        object.__setattr__(self, "frames", cached)

    @property
    def timeline(self) -> Timeline:
        """Times at which the frames were recorded."""
        return Timeline(self.rig, {name: len(frames) for name, frames in self.frames.items()}, self.alpha)

    def recorded(self, i: int) -> Float[Tensor, "1 h w"]:
        """Return alpha's frame in grey, as recorded.

        Raises:
            ValueError: for an image of other bands than one or three.
        """
        return grey_alpha(self.alpha, self.frames[self.alpha][i])

    def grey(self, i: int) -> Float[Tensor, "1 h w"]:
        """Return alpha's frame in grey, denoised if its noise is known or estimated, to find motion in."""
        return grey_alpha(self.alpha, self._quiet[i])

    def base(self, i: int) -> Float[Tensor, "1 h w"]:
        """Return the image that colours are added to: alpha as recorded with `keep_alpha`, else `grey`."""
        return self.recorded(i) if self.settings.keep_alpha else self.grey(i)

    def alone(self, i: int) -> Frame:
        """Return a frame fused alone with the betas nearest in time, for comparison with warping."""
        return self._fused(i, self.timeline.at(i), {}, alone=True)

    def colour(self, key: KeyFrame) -> KeyColour:
        """Fuse a key frame; in each beta points are searched where they are at its time.

        Returns:
            The colour that fusion adds to alpha, with depth, and confidence, lowered where motion is unsure.

        Raises:
            ValueError, TypeError: as `fuse_frame`, and if an image cannot be read.
            OSError: for an image file that is missing.
        """
        fields, weight = {}, torch.ones(self.rig[self.alpha].hw)
        for name, i in key.betas.items():
            fields[name], certain = self._field(name, key.alpha, self.timeline.time(name, i))
            weight = torch.minimum(weight, certain)
        frame = self._fused(key.alpha, key.betas, fields)
        inverse = torch.stack([1 / frame.depth, frame.half_width]).nan_to_num(0.0)
        return KeyColour(frame.image - self.base(key.alpha), frame.confidence * weight, inverse)

    def frame(self, i: int, keys: Sequence[KeyFrame], fetch: Callable[[KeyFrame], KeyColour | None]) -> Frame:
        """Compute any frame, its colour warped from the key frames around it.

        Args:
            i: number of alpha's frame.
            keys: the key frames.
            fetch: function that returns a key frame's colour, or None for one that could not be fused.

        Returns:
            The frame, without `by_band`.

        Raises:
            ValueError: without keys, if none of those around it could be fused, or an image cannot be read.
            OSError: for an image file that is missing.
            IndexError: for a frame that alpha does not have, as one below 0.
        """
        around, grey = self._around(i, keys), self.grey(i)
        fetched = ((key, fetch(key)) for key in around)
        sources = [self._warped(i, grey, key, colour) for key, colour in fetched if colour]
        if not sources:
            raise ValueError(f"frame {i}: none of the key frames around it could be fused")
        return mixed(self.base(i), sources)

    def keys_of(self, frames: Iterable[int]) -> list[KeyFrame]:
        """Return the key frames from which some frames get their colour."""
        keys = self.timeline.key_frames()
        wanted = {key.alpha for i in frames for key in self._around(i, keys)}
        return [key for key in keys if key.alpha in wanted]

    def _around(self, i: int, keys: Sequence[KeyFrame]) -> list[KeyFrame]:
        """Return the key frames within reach, or the nearest one."""
        gaps = {k.alpha: abs(self._time(k.alpha) - self._time(i)) for k in keys}
        longest = max(SETTINGS.intervals * self.timeline.interval * (1 - 1e-9), min(gaps.values()))
        return [k for k in keys if gaps[k.alpha] <= longest]

    def _warped(self, i: int, grey: Tensor, key: KeyFrame, colour: KeyColour) -> tuple[float, KeyColour]:
        """Return the nearness in time of a key frame, 0 to 1, and its colour, warped to a frame."""
        gap = abs(self._time(key.alpha) - self._time(i))
        nearness = max(1 - gap / (SETTINGS.intervals * self.timeline.interval), 1e-3)
        if key.alpha == i:
            return nearness, colour
        LOG.info("motion of frame %d", i)
        flow = flow_between(grey, self.grey(key.alpha))
        moved = warped(torch.cat([colour.added, colour.confidence[None]]), flow.step)
        has_depth = (colour.inverse_depth[:1] > 0).to(colour.inverse_depth)
        share, *inverse = warped(torch.cat([has_depth, colour.inverse_depth]), flow.step)
        # An unknown neighbour is not infinitely far away.
        inverse_depth = torch.where(share < 0.5, 0.0, torch.stack(inverse) / share.clamp(min=0.5))
        return nearness, KeyColour(moved[:-1], moved[-1] * flow.weight, inverse_depth)

    def _time(self, i: int) -> float:
        return self.timeline.time(self.alpha, i)

    def _field(self, name: str, index: int, time: float) -> tuple[ReceptiveField, Tensor]:
        """Return the field of a beta that records at `time`, and the weight of the motion until then."""
        field = self._given_field(name) or straight_field(self.rig.pair(self.alpha, name))
        weight = torch.ones(self.rig[self.alpha].hw)
        steps = (time - self._time(index)) * self.timeline.rate(self.alpha)
        count = len(self.frames[self.alpha])
        if abs(steps) < SETTINGS.synchronous or count < 2:
            return field, weight
        towards = 1 if steps > 0 else -1
        other = min(max(index + (round(steps) or towards), 0), count - 1)
        other = other if other != index else index - towards
        LOG.info("motion of key frame %d", index)
        flow = flow_between(self.grey(index), self.grey(other))
        step = flow.step * (steps / (other - index))
        if self.speed is None:
            room = SETTINGS.unknown_motion * float(step.norm(dim=0).flatten()[::16].quantile(0.995))
        else:
            room = self.speed * abs(time - self._time(index))
        return Moved(Widened(field, along=room), step), flow.weight

    def _fused(
        self, i: int, betas: Mapping[str, int], fields: Mapping[str, ReceptiveField], *, alone: bool = False
    ) -> Frame:
        """Fuse alpha's frame with those of betas.

        Levels are matched over several frames, or in this one if it is alone or to be denoised.
        """
        images = {name: self.frames[name][j] for name, j in betas.items()}
        alone = alone or self.settings.noise is not None
        match_levels = self.settings.match_levels
        levels = self._levels(images, i) if match_levels and not alone else None
        if levels is not None:
            alpha_level, beta_levels = levels
            images = {name: beta_levels[name].matched(image, alpha_level) for name, image in images.items()}
        settings = replace(
            self.settings,
            field={**{name: self._given_field(name) for name in betas}, **fields},
            match_levels=match_levels and alone,
            noise=self._noise,
        )
        frame = fuse_frame(
            {self.alpha: self.recorded(i), **images},
            self.rig,
            alpha=self.alpha,
            network=self.network,
            settings=settings,
            corrections=self._corrections,
        )
        if levels is None or self.network.keeps_luminance:
            return frame
        return with_own_levels(
            frame, [len(image) for image in images.values()], alpha_level, [*beta_levels.values()]
        )

    def _given_field(self, name: str) -> ReceptiveField | None:
        """Return a beta's field, where one is given."""
        field = self.settings.field
        return field.get(name) if isinstance(field, Mapping) else field

    @cached_property
    def _corrections(self) -> Corrections:
        """Corrections of every frame, estimated once, near the middle, so that nothing flickers.

        Betas that did not record at alpha's time are not aligned: motion too moves points off their segments.
        """
        LOG.info("corrections of the sequence")
        return self._at_middle(self._found_at, Corrections(Response.rec601()))

    @cached_property
    def _noise(self) -> Mapping[str, NoiseLevel] | None:
        """Noise of each camera, stated or estimated once, near the middle; None without denoising."""
        noise = self.settings.noise
        if not isinstance(noise, str):
            return noise
        nothing: Mapping[str, NoiseLevel] = {}
        return self._at_middle(lambda key: noise_levels(self._images_at(key), noise), nothing)

    @cached_property
    def _quiet(self) -> Frames:
        """Frames of alpha, denoised if it has noise."""
        frames, level = self.frames[self.alpha], (self._noise or {}).get(self.alpha)
        return frames if level is None else CachedFrames(frames, level)

    def _at_middle(self, find: Callable[[KeyFrame], T], otherwise: T) -> T:
        """Return a function's result at the key frame nearest to the middle whose images can be read.

        An error is reported when that frame is fused.
        """
        keys = self.timeline.key_frames()
        for key in sorted(keys, key=lambda key: abs(key.alpha - keys[len(keys) // 2].alpha)):
            try:
                return find(key)
            except (OSError, ValueError):
                continue
        return otherwise

    def _images_at(self, key: KeyFrame) -> dict[str, Tensor]:
        """Return alpha's image and those of the betas, as recorded."""
        betas = {name: self.frames[name][j] for name, j in key.betas.items()}
        return {self.alpha: self.recorded(key.alpha), **betas}

    def _found_at(self, key: KeyFrame) -> Corrections:
        gaps = (self._time(key.alpha) - self.timeline.time(name, j) for name, j in key.betas.items())
        together = all(abs(gap) * self.timeline.rate(self.alpha) < SETTINGS.synchronous for gap in gaps)
        align = self.settings.align is not False and together
        return corrections_of(
            self._images_at(key),
            self.rig,
            alpha=self.alpha,
            network=self.network,
            settings=replace(self.settings, align=align, noise=self._noise),
        )

    def _levels(self, names: Iterable[str], i: int) -> tuple[Moments, dict[str, Moments]]:
        """Return moments of alpha's and each beta's images over several key frames, so as not to flicker."""
        keys = self.timeline.key_frames()
        nearest = min(range(len(keys)), key=lambda k: abs(keys[k].alpha - i))
        around = keys[max(nearest - SETTINGS.neighbours, 0) : nearest + SETTINGS.neighbours + 1]
        alpha_level = mean_moments(readable(self.grey, [k.alpha for k in around]))
        return alpha_level, {
            name: mean_moments(readable(self.frames[name].__getitem__, [k.betas[name] for k in around]))
            for name in names
        }


def readable(read: Callable[[int], Tensor], numbers: Iterable[int]) -> Iterator[Tensor]:
    """Yield the images that can be read; an error is reported when that frame is fused."""
    for i in numbers:
        with suppress(OSError, ValueError):
            yield read(i)


def mixed(base: Float[Tensor, "1 h w"], sources: Sequence[tuple[float, KeyColour]]) -> Frame:
    """Mix the colours of key frames into alpha's frame, weighted by nearness in time and confidence.

    Args:
        base: alpha's frame.
        sources: nearness in time, above 0, and the colour of each key frame, warped to this frame; at least
            one.

    Returns:
        The frame, without `by_band`; depth is NaN where no source has any. Its confidence is the weighted
        mean of the sources', lowered where sources of about the same weight disagree.
    """
    weights = torch.stack([nearness * (s.confidence + SETTINGS.floor) for nearness, s in sources])
    share = (weights / weights.sum(0))[:, None]
    added, confidences, of_sources = map(torch.stack, zip(*(colour for _, colour in sources)))
    colour = (share * added).sum(0)
    apart = (share * (added - colour).square()).sum((0, 1))
    confidence = (share[:, 0] * confidences).sum(0)
    weights = torch.where(of_sources[:, 0] > 0, weights, 0.0)
    has_depth = weights.sum(0) > 0
    inverse, half_width = (weights[:, None] * of_sources).sum(0) / weights.sum(0).clamp(min=1e-12)
    depth = torch.where(has_depth, 1 / torch.where(has_depth, inverse, 1.0), torch.nan)
    agreeing = torch.exp(-apart / UNLIKE**2)
    return Frame(base + colour, depth, confidence * agreeing, torch.where(has_depth, half_width, torch.nan))


def fuse_sequence(
    frames: Mapping[str, Frames],
    rig: Rig,
    *,
    alpha: str,
    network: FusionNetwork,
    speed: float | None = None,
    settings: FuseSettings = FuseSettings(),
) -> Iterator[Frame]:
    """Fuse every frame of alpha, in order, as they are asked for.

    Args:
        frames: frames by camera name, in the order of time. The rig's other cameras are left out.
        rig: cameras with `frame_rate` (per second) and `time_offset` (seconds after a common clock).
        alpha: camera whose frames are wanted.
        network: network that fuses key frames.
        speed: largest speed of motion, pixels of alpha a second, for the margin of fields where a beta did
            not record at a key frame's time. None for a quarter of the motion seen between alpha's frames.
        settings: settings of fusion; response and noise, and alignment if all betas recorded at alpha's time
            there, are estimated once, at the key frame nearest to the middle whose images can be read.

    Yields:
        Frames at alpha's pixels.

    Raises:
        ValueError: for a negative or infinite speed, a camera that the rig lacks, unknown frame rates,
            recordings that do not overlap in time, and a frame that cannot be fused.
        OSError: for an image file that is missing. All come when the frames are asked for.
        TypeError: for a speed that is no number, and as `fuse_frame`.
    """
    job = SequenceFusion(network, rig, frames, alpha, speed, settings)
    keys = job.timeline.key_frames()
    job.timeline.warn_of_ends()

    @lru_cache(maxsize=2 * int(SETTINGS.intervals) + 1)
    def colour(number: int) -> KeyColour:
        return job.colour(keys[number])

    for i in range(len(frames[alpha])):
        yield job.frame(i, keys, lambda key: colour(keys.index(key)))
