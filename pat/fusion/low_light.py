"""Fusion of noisy views: denoised before they are matched, joined with the betas' recordings after fusion."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import sample
from arraygeom.pixels import HW
from arraygeom.runtime.chunks import chunked
from arraygeom.runtime.warned import warn

from ..matching.band_mix import Response
from ..networks.bm3d import Observation, other_camera_update, without_noise
from ..networks.weights import load_denoiser
from ..sensors import NoiseLevel, generator_for
from ..sensors.steps import normal
from ..support.convolutions import convolutions_in_parallel
from ..support.settings import physics, size, tuned
from .frame import Frame
from .non_local_means import averaged_with_alike
from .steps import FusionStep
from .views import Views

LOG = logging.getLogger(__name__)

Noise = Literal["estimate", "auto"] | Mapping[str, NoiseLevel]
"""Noise level of each camera that has noise, or "estimate" to estimate it from the images, or "auto" to do so
only where an image shows noise plainly."""


@dataclass(frozen=True)
class LowLightSettings:
    """Settings of fusion with noise.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    least_deviation: float = physics(
        1.5 / 255, "Images whose noise has a smaller standard deviation, in the mean, are left as they are"
    )
    plain: float = tuned(
        8 / 255,
        "Tune half: the deviation that an image shows plainly. Images without noise show .3 to 4.9 (6.4 of a "
        "fine cloth, reduced); with 200 electrons from 9.7, and the fused image gains 1.9 to 8.5 dB",
    )
    middle: int = size(1024, "Side of the part of an image in which noise is looked for, pixels")
    far_more: float = physics(
        5.0,
        "Warn if the stated noise is more than this many times the noise measured in the image (the least "
        "deviation at least): noise that a demosaicing has smoothed shows as half or less",
    )
    found_bytes: float = size(12.0, "Of a position in a beta and its confidence")
    averaging: float = size(0.4, "The time of averaging over that of denoising the views, about")


SETTINGS = LowLightSettings()

in_tiles = partial(chunked, rows=1024, halo=128, axis=(-2, -1))
"""Function that denoises images in tiles of this side, with so many pixels around them."""
shipped_denoiser = cache(lambda device: load_denoiser().to(device))
"""Function that returns the network that ships with the package on a device, read once for each."""


class NoisyView(NamedTuple):
    """A noisy view, each tensor (1, C, H, W).

    Attributes:
        recorded: values as recorded, but unbiased.
        denoised: values without noise.
        deviation: standard deviation of the noise.
    """

    recorded: Tensor
    denoised: Tensor
    deviation: Tensor


@dataclass(frozen=True)
class LowLight:
    """Views of a frame before and after denoising, kept to restore recorded detail once it is fused.

    Attributes:
        given: views as recorded; without images if no view had noticeable noise.
        views: views after denoising; without images if no view had noticeable noise.
        noisy: recorded and denoised image, and noise, of each camera that had noticeable noise, by name.
        seconds_left: estimated time of `corrected`, seconds.
    """

    given: Views
    views: Views
    noisy: Mapping[str, NoisyView]
    seconds_left: float = 0.0

    def described(self) -> str:
        """Return a sentence on the denoised views and their deviations."""
        texts = (f"{name} {255 * float(view.deviation.mean()):.0f}/255" for name, view in self.noisy.items())
        return f"noise shows plainly and is removed: {', '.join(texts)}; --noise none leaves it"

    def kept(self, hw: HW, betas: int) -> float:
        """Return the bytes held until a frame of this size is corrected: views, positions in each beta."""
        if not self.noisy:
            return 0.0
        images = [*self.given.images.values(), *self.views.images.values()]
        parts = [tensor for view in self.noisy.values() for tensor in view]
        kept_bytes = math.prod(hw) * betas * SETTINGS.found_bytes
        return kept_bytes + sum({tensor.data_ptr(): tensor.nbytes for tensor in (*images, *parts)}.values())

    def corrected(
        self,
        frame: Frame,
        matched: Float[Tensor, "n 3 h w"],
        steps: Sequence[FusionStep],
        response: Response,
        *,
        keep_alpha: bool = False,
    ) -> Frame:
        """Add the brightness and colours that betas recorded to a frame fused from the denoised views.

        Betas add nothing unless all are RGB, and brightness only to a noisy alpha that is similar to a
        combination of their bands, without `keep_alpha`.

        Args:
            frame: frame fused from the denoised views, its steps not undone yet.
            matched: positions of its pixels in each beta, x and y, with their confidence.
            steps: steps before it was fused, without the one of radiometry: values keep their scale.
            response: response that brings betas to alpha's exposure.
            keep_alpha: True to add alpha's recorded noise again, in place of the betas' brightness.

        Returns:
            The frame with the new image; as given if no view was noisy.
        """
        if not self.noisy:
            return frame
        LOG.info("denoising the fused image")
        alpha, image, views = self.views.alpha, frame.image, self.prepared(steps)
        alpha_view = views.pop(alpha)
        if all(view.recorded.shape[1] == 3 for view in views.values()):
            betas = [exposed(view, response) for view in views.values()]
            if alpha in self.noisy and response.explains and not keep_alpha:
                grain = self._grain(steps)
                seen = [brightness(view, grain[name][None], response) for name, view in zip(views, betas)]
                image = image + brightness_change(alpha_view, seen, matched)
            image = colours_averaged(image, betas, matched)
        if keep_alpha:
            image = image + self._stepped(self.given.images, steps)[alpha] - alpha_view.denoised[0]
        return frame._replace(image=image)

    def prepared(self, steps: Sequence[FusionStep]) -> dict[str, NoisyView]:
        """Return every view as recorded, denoised, and its deviation, after the steps before it is fused."""
        quiet = {n: NoisyView(x[None], x[None], 0 * x[None]) for n, x in self.views.images.items()}
        views = {**quiet, **self.noisy}
        parts = [self._stepped({name: view[i][0] for name, view in views.items()}, steps) for i in range(3)]
        return {name: NoisyView(*(images[name][None] for images in parts)) for name in parts[0]}

    def _grain(self, steps: Sequence[FusionStep]) -> Mapping[str, Float[Tensor, "c h w"]]:
        """Return white noise of unit deviation in each beta after the steps, of which some smooth it."""
        middle, scale = 0.5, 0.1  # images are within 0..1
        drawn = {
            name: middle + scale * normal(image.shape, image, generator_for(0, name))
            for name, image in self.given.images.items()
            if name != self.given.alpha
        }
        return {name: (image - middle) / scale for name, image in self._stepped(drawn, steps).items()}

    def _stepped(self, images: Mapping[str, Tensor], steps: Sequence[FusionStep]) -> Mapping[str, Tensor]:
        views = self.views.replace(images)
        for step in steps:
            views = step(views).views
        return views.images


def denoised_views(views: Views, noise: Noise | None) -> tuple[Views, LowLight]:
    """Denoise the views that have noticeable noise.

    Warns if the noise stated for a camera is far more than its image shows.

    Args:
        noise: noise level by camera, "estimate" to estimate each, "auto" to do so only if an image shows
            noise plainly; None for no denoising.

    Returns:
        The views after denoising (as given where noise is not noticeable, `SETTINGS.least_deviation`), and
        both versions for `LowLight.corrected`.

    Raises:
        ValueError: for a camera without an image among the views, or a `noise` of another kind.
    """
    begin = time.perf_counter()
    noisy: dict[str, NoisyView] = {}
    for name, level in noise_levels(views.images, noise).items():
        if name not in views.images:
            raise ValueError(f"noise of '{name}': there is no image of it, only of {', '.join(views.images)}")
        LOG.info("denoising %s", name)
        if (view := noisy_view(views.images[name], level)) is not None:
            if not isinstance(noise, str):
                warn_of_noise(name, views.images[name], view)
            noisy[name] = view
    if not noisy:
        without = replace(views, images={})
        return views, LowLight(without, without, {})
    denoised = views.replace({name: view.denoised[0] for name, view in noisy.items()})
    return denoised, LowLight(views, denoised, noisy, SETTINGS.averaging * (time.perf_counter() - begin))


def warn_of_noise(name: str, image: Float[Tensor, "c h w"], view: NoisyView) -> None:
    """Warn if the noise that is stated for an image is far more than it shows.

    Far more is by `SETTINGS.far_more`; noise under `least_deviation` counts as that. There is no warning
    where the image shows none at all.

    Args:
        name: name of the camera.
        image: image as recorded, values 0..1.
        view: the image with the stated noise.
    """
    shown = NoiseLevel.estimated(image[None])
    deviations = view.deviation, shown.deviation(image[None])
    stated, measured = (255 * float(deviation.mean()) for deviation in deviations)
    if shown != NoiseLevel() and stated > SETTINGS.far_more * max(measured, 255 * SETTINGS.least_deviation):
        warn(
            f"noise of '{name}': a standard deviation of {stated:.0f}/255 is stated, "
            f"its image shows {measured:.1f}/255: detail will be lost; state electrons at white, "
            "or have the noise estimated"
        )


def shown_noise(image: Float[Tensor, "c h w"]) -> float:
    """Estimate the standard deviation of the noise in the middle of an image."""
    side = SETTINGS.middle
    top, left = (max(n - side, 0) // 2 for n in image.shape[-2:])
    middle = image[None, :, top : top + side, left : left + side].detach().clamp(0, 1)
    return float(NoiseLevel.estimated(middle).deviation(middle).mean())


def check_noise(noise: Noise | None) -> None:
    """Raise ValueError for a value that is no noise."""
    if noise is None or noise in ("estimate", "auto"):
        return
    if not (isinstance(noise, Mapping) and all(isinstance(level, NoiseLevel) for level in noise.values())):
        raise ValueError(
            f"noise is 'estimate', 'auto' or a NoiseLevel of each camera; got {noise!r}: "
            "give {NAME: NoiseLevel.from_electrons(200)}"
        )


def noise_levels(images: Mapping[str, Tensor], noise: Noise | None) -> Mapping[str, NoiseLevel]:
    """Return the noise level of each camera that has noise: as stated, or estimated from its image.

    Args:
        images: images (C, H, W), values 0..1, by camera.
        noise: levels by camera, "estimate", "auto" to estimate them if an image shows noise plainly, or None.

    Returns:
        Levels by camera, the given mapping itself, or those of all images; empty for None, and for "auto" if
        no image shows noise plainly.

    Raises:
        ValueError: for a `noise` of another kind.
    """
    check_noise(noise)
    if noise == "auto" and max(map(shown_noise, images.values()), default=0.0) < SETTINGS.plain:
        return {}
    if isinstance(noise, str):
        return {name: NoiseLevel.estimated(image[None]) for name, image in images.items()}
    return noise or {}


def noisy_view(image: Float[Tensor, "c h w"], level: NoiseLevel) -> NoisyView | None:
    """Return an image as recorded but unbiased, and denoised; None if there is hardly any noise."""
    deviation = level.deviation(image[None])
    if float(deviation.mean()) <= SETTINGS.least_deviation:
        return None
    recorded = level.unbiased(image[None])
    return NoisyView(recorded, denoised(recorded, deviation), deviation)


def exposed(view: NoisyView, response: Response) -> NoisyView:
    """Return a beta at alpha's exposure; its deviation by the difference that one deviation makes."""
    if response.is_rec601:
        return view
    more, less = (response.exposed(view.denoised + sign * view.deviation) for sign in (1, -1))
    return NoisyView(response.exposed(view.recorded), response.exposed(view.denoised), (more - less) / 2)


@convolutions_in_parallel()
@torch.no_grad()
def denoised(
    image: Float[Tensor, "b c h w"], deviation: Float[Tensor, "b c h w"]
) -> Float[Tensor, "b c h w"]:
    """Denoise images with noise of this deviation; bands other than three are taken one by one.

    Returns:
        Images without noise, in their own type and on their device, not clipped, detached.
    """
    network, dtype = shipped_denoiser(image.device), image.dtype
    image, deviation = image.float(), deviation.float()
    if image.shape[1] == 3:
        return in_tiles(partial(without_noise, network.colour), image, deviation).to(dtype)
    bands = zip(image.split(1, 1), deviation.split(1, 1))
    return torch.cat([in_tiles(partial(without_noise, network.band), *band) for band in bands], 1).to(dtype)


class Brightness(NamedTuple):
    """A beta's bands combined as alpha's response combines them, in planes (1, 1, H, W).

    Attributes:
        recorded: brightness as recorded, noise included.
        deviation: standard deviation of its noise.
        grain: a sample of its noise, at unit deviation.
    """

    recorded: Tensor
    deviation: Tensor
    grain: Tensor


def brightness(view: NoisyView, grain: Float[Tensor, "1 3 h w"], response: Response) -> Brightness:
    """Combine the bands of an RGB beta to the brightness that alpha sees; their noise is independent.

    Args:
        view: the beta at alpha's exposure.
        grain: sample of noise of unit deviation in each band.
        response: response whose weights combine the bands.

    Returns:
        The brightness, with its noise.
    """
    weights = response.weights.to(view.recorded)[:, None, None]
    deviation = (weights * view.deviation).square().sum(1, keepdim=True).sqrt()
    recorded, mixed = ((weights * image).sum(1, keepdim=True) for image in (view.recorded, grain))
    return Brightness(recorded, deviation, mixed / weights.square().sum().sqrt())


@torch.no_grad()
def brightness_change(
    alpha: NoisyView, betas: Sequence[Brightness], matched: Float[Tensor, "n 3 h w"]
) -> Float[Tensor, "1 h w"]:
    """Compute the update of alpha's denoised brightness by the betas' recordings, one beta after another.

    Args:
        alpha: alpha as recorded and denoised.
        betas: brightness in each beta, at its own pixels.
        matched: positions of alpha's pixels in each beta, x and y, with their confidence.

    Returns:
        Values to add to each band, (1, H, W), without gradient.
    """

    def changed(estimate: Tensor, *planes: Tensor) -> Tensor:
        first, deviation, *other = (plane[0] for plane in planes)
        return other_camera_update(estimate[0], first, deviation, Observation(*other))[None]

    estimate = alpha.denoised
    for beta, found in zip(betas, matched):
        positions, confidence = found[:2].movedim(0, -1), found[None, 2:].to(estimate)
        there = (sample(plane, positions[None]).values for plane in beta)
        estimate = estimate + in_tiles(changed, estimate, alpha.recorded, alpha.deviation, *there, confidence)
    return (estimate - alpha.denoised)[0]


@torch.no_grad()
def colours_averaged(
    image: Float[Tensor, "3 h w"], betas: Sequence[NoisyView], matched: Float[Tensor, "n 3 h w"]
) -> Float[Tensor, "3 h w"]:
    """Average the fused image's colours with those that RGB betas recorded, over similar pixels nearby.

    Args:
        image: image fused from the denoised views.
        betas: recorded and denoised images of each beta, at alpha's exposure.
        matched: positions of alpha's pixels in each beta, x and y, with their confidence.

    Returns:
        The image with the same luma, without gradient; the tensor `image` itself without noise in the betas.
    """
    beta, confidence = warped(betas, matched)
    deviation = float(beta.deviation.mean())
    if not deviation:
        return image

    def averaged(fused: Tensor, recorded: Tensor, confidence: Tensor) -> Tensor:
        return averaged_with_alike(fused[0], recorded[0], confidence[0], deviation)[None]

    return in_tiles(averaged, image[None], beta.recorded, confidence)[0]


def warped(
    betas: Sequence[NoisyView], matched: Float[Tensor, "n 3 h w"]
) -> tuple[NoisyView, Float[Tensor, "1 1 h w"]]:
    """Warp all betas, of the same bands, to alpha's pixels, and average them weighted by their confidences.

    Args:
        matched: positions of alpha's pixels in each beta, x and y, with their confidence.

    Returns:
        The average, as recorded, denoised and deviation, and the largest confidence of a beta. A beta counts
        as 0 off its image; without any confidence all count alike.
    """
    positions, confidence = matched[:, :2].movedim(1, -1), matched[:, 2]
    images = [
        torch.cat([sample(plane, x[None]).values for plane in beta]) for beta, x in zip(betas, positions)
    ]
    weight = (confidence + 1e-6) / (confidence + 1e-6).sum(0)
    mixed = torch.stack([w * image for w, image in zip(weight, images)]).sum(0)
    return NoisyView(*mixed.split(1)), confidence.amax(0)[None, None]
