"""Whole frames: a rig and one image a camera in, one fused image out."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from arraygeom import ReceptiveField, Rig
from arraygeom.runtime.chunks import Tile
from arraygeom.runtime.threads import torch_in_one_thread
from arraygeom.runtime.tracing import transformations
from arraygeom.runtime.warned import warn

from ..matching.inputs import Inputs
from ..matching.match import Matcher, match
from ..matching.matches import Matches
from ..matching.radiometry import ResponseSpec, given_response
from ..media.images import Images
from ..networks.protocol import FusionNetwork
from ..networks.weights import load_weights, weights_for
from ..support.blocks import without_autocast
from ..support.memory import limited, parse_bytes, planned
from .checks import warn_of_confidence
from .corrections import Corrections, expected_work, find_corrections
from .depth_edges import beside_edges
from .depth_filling import background_filled
from .inputs import FrameInputs, bytes_beside, prepared
from .low_light import LowLight, Noise, check_noise, denoised_views
from .luminance import SHARES, Luminance, check_luminance, with_alpha_detail, with_own_colours
from .results import Frame
from .steps import Undo, steps_for, undone
from .tiles import LARGE, Plan, fused_in_tiles, plan_frame
from .views import Views, check_bands

LOG = logging.getLogger(__name__)
T = TypeVar("T")

ImageSources = Mapping[str, str | Path | Tensor] | Sequence[str | Path]
"""An image file or tensor (C, H, W) in 0..1 of each camera by name; or files alone, which name cameras."""
Progress = Callable[[Iterable[Tile], int], Iterable[Tile]]
"""Wraps the tiles (and their number) to show how far the work is, as `rich.progress.track` does."""


@dataclass(frozen=True)
class FuseSettings:
    """How frames are fused: what one frame, many and a sequence have in common.

    depth: (near, far) in metres, instead of the rig's.
    field: the receptive field, or one for each of some betas, by name; by default `arraygeom`'s
        `default_field`.
    max_memory: bytes, or like "4GiB": what the process may take in all, libraries and images included, if
        there is nothing else in it. Default: no limit.
    match_levels: bring each beta to alpha's mean and standard deviation first, for cameras whose exposures or
        filters differ and which are not radiometrically calibrated.
    response: how alpha weighs red, green and blue of its one colour beta. "fit" fits it to matches, with a
        gain and a gamma, and leaves it at Rec. 601 luma ("rec601") where that explains the images as well;
        three numbers state it. The result has alpha as this combination of its colours.
    align: find how far the betas lie across their search segments, and put that right; by default unless the
        fusion is differentiable, where a rig that is put right has no gradient of being off.
    noise: the noise level of each camera that has some, or "estimate": views are denoised before they are
        matched, and jointly once they are fused. "auto", as without rig: so where an image shows noise
        plainly ({} never).
    keep_alpha: leave alpha's values as recorded, noise included; otherwise so if alpha has no noise to speak
        of.
    luminance: the image's: "alpha", which the network keeps exactly, that of "beta" in alpha's detail, where
        alpha sees another part of the spectrum, or their "mix".

    Raises ValueError for a noise or a response that is none.
    """

    depth: tuple[float, float] | None = None
    field: ReceptiveField | Mapping[str, ReceptiveField | None] | None = None
    max_memory: float | str | None = None
    match_levels: bool = False
    response: ResponseSpec = "fit"
    align: bool | None = None
    noise: Noise | None = None
    keep_alpha: bool = False
    luminance: Luminance = "alpha"

    def __post_init__(self) -> None:
        check_noise(self.noise)
        given_response(self.response)

    @property
    def limit(self) -> float | None:
        """The memory limit in bytes, if there is one."""
        return None if self.max_memory is None else parse_bytes(self.max_memory)

    def changed(self, changes: Mapping[str, Any]) -> FuseSettings:
        """The settings with some of them changed. Raises TypeError for a name that is none of theirs."""
        names = [entry.name for entry in fields(self)]
        if unknown := [name for name in changes if name not in names]:
            raise TypeError(
                f"there is no argument or setting '{unknown[0]}': settings are {', '.join(names)}; "
                "on a GPU is fused what is there, by `.to` of network, rig and images"
            )
        return replace(self, **changes)


@torch_in_one_thread()
@without_autocast()
def fuse(
    network: FusionNetwork | ImageSources,
    rig: Rig | None = None,
    images: Images | None = None,
    *,
    alpha: str | None = None,
    settings: FuseSettings = FuseSettings(),
    corrections: Corrections | None = None,
    explain: Callable[[str], None] | None = None,
    progress: Progress | None = None,
    announce: Callable[[Plan], None] | None = None,
    store: Path | None = None,
    differentiable: bool = False,
    matcher: Matcher = match,
    **changes: Any,
) -> Frame:
    """Fuse one frame at camera `alpha`'s view: `fuse(network, rig, images, alpha=...)`, or `fuse(images)`.

    Images alone are files, or files or tensors by camera; their rig and the weights are found as by `pat
    fuse` (`pat.app.from_images.array_from_images`, which also gives them), and depths are multiples of the
    baseline. Frames too large for the memory allowed are fused in tiles of alpha, each with the part of every
    beta that its segments touch, and a halo: equal to the whole to 1e-4. Distorted images are first resampled
    to pinhole views (`pat.fusion.steps.undistort`), rotated betas made upright, and betas resized to alpha's
    angular resolution; the result is at alpha's own pixels all the same. Where alpha is known to measure the
    luminance of linear light and one beta the colours, the result is as bright in that sense
    (`pat.media.raw.match_luminance`).

    Args:
        network: for instance `load_weights("mono-colour")`; or, without rig, the images.
        rig: the cameras. Those without an image in `images` are left out.
        images: tensors by camera name, (C, H, W) in 0..1, each of the size that the rig states. A mapping
            that reads them when asked saves memory (`pat.fusion.views.ViewFiles`).
        alpha: the camera whose view is wanted; without a rig by default the largest grey image.
        settings: what frames of the same cameras have in common; any of `FuseSettings` may be given as an
            argument of its own, as `noise="estimate"`.
        corrections: what is known of response and alignment from another frame of the same cameras
            (`corrections_of`), instead.
        explain: called with a line for each thing that was found and put right.
        progress: shows the tiles as they are done.
        store: a folder for finished tiles of a frame of several, so that one that was stopped goes on;
            tiles of other images, rigs or weights are not taken. Whoever gave it removes it afterwards.
        differentiable: keep gradients with respect to the numbers of the rig, the images and the network's
            weights (which `requires_grad_(True)` frees). A match moves along its segment as images and rig
            move the best agreement around it; which match is the best, `align` and `response` are constants.
            Else the frame is detached, whatever requires gradients.
        matcher: what finds the matches of a network that uses some: `pat.matching.match.match`, or your own.
        announce: called with the plan before the work begins; the time of a large frame is estimated by
            fusing a piece.

    Raises:
        ValueError: a camera that the rig lacks, an image of another size, a rig whose views do not overlap,
            bands that the network does not make, `differentiable` with `max_memory`, `store` or `noise`.
        NotImplementedError: within a transformation of `torch.func`.

    Warns:
        LowConfidenceWarning: the images hardly match: the rig is probably wrong. A filter makes it an error,
            as `warnings.simplefilter("error", LowConfidenceWarning)`.
    """
    settings = _given(FuseSettings, settings).changed(changes)
    automatic = rig is None and settings.luminance == "alpha" and not differentiable
    network, rig, images, alpha, grey_world = _with_rig(network, rig, images, alpha, explain)
    settings = replace(
        settings,
        noise="auto" if automatic and settings.noise is None else settings.noise,
        align=not differentiable if settings.align is None else settings.align,
        match_levels=settings.match_levels or grey_world,
    )
    in_parts, luminance = settings.max_memory is not None or store is not None, settings.luminance
    _check_gradients(differentiable, in_parts=in_parts, noisy=bool(settings.noise))
    check_luminance(network, luminance, noisy=settings.noise is not None)
    _, inputs, undo, plan, fitted, low_light, in_colour = ready_frame(
        network,
        rig,
        images,
        alpha,
        settings,
        corrections=corrections and _given(Corrections, corrections),
        stored=store is not None,
        explain=explain,
        announce=announce,
    )
    if in_colour:
        text = "is in colour: colours come from the betas, its own only where they do not see"
        warn(f"the image of alpha, '{alpha}', {text}")
    noisy = bool(low_light.noisy)
    right = replace(inputs.inputs, luminance=SHARES[luminance])
    inputs = inputs._replace(inputs=right)
    with limited(planned(settings.limit, plan.memory, large=math.prod(inputs.hw) > LARGE)):
        with torch.set_grad_enabled(differentiable):
            matches = matches_by(matcher, inputs.inputs) if network.uses_matches else None
            LOG.info("fusing %d tile%s", len(plan.tiles), "s" * (len(plan.tiles) > 1))
            fused = fused_in_tiles(
                network, inputs, matches, plan.tiles, keep_matched=noisy, progress=progress, store=store
            )
            del matches
        warn_of_confidence(network, fused.frame, inputs)
        depth = beside_edges(background_filled(fused.frame, inputs), fused.frame, inputs)
        frame = fused.frame._replace(depth=depth)
        if luminance != "alpha":
            frame = with_alpha_detail(frame, inputs.inputs.alpha[0, :, : inputs.hw[0], : inputs.hw[1]])
        del inputs, right  # the segments of a large frame: what follows needs memory, too
        taken = steps_for(network, normalise=False), fitted.response
        frame = fitted.undone(frame)
        frame = low_light.corrected(frame, fused.matched, *taken, keep_alpha=settings.keep_alpha)
        LOG.info("back to the pixels of %s", alpha)
        frame = undone(frame, undo)
        if in_colour and len(frame.image) == 3 and frame.by_band is None and not noisy:
            frame = with_own_colours(frame, images[alpha])
        return frame if differentiable else frame.mapped(Tensor.detach)


class ReadyFrame(NamedTuple):
    """A frame ready to be matched: the network, its inputs as they are put right, how a frame of these is
    taken back to alpha's pixels, the plan, what was put right, what is known of noise, and whether alpha was
    in colour."""

    network: FusionNetwork
    inputs: FrameInputs
    undo: list[Undo]
    plan: Plan
    corrections: Corrections
    low_light: LowLight
    in_colour: bool


def ready_frame(
    network: FusionNetwork | None,
    rig: Rig,
    images: Images,
    alpha: str,
    settings: FuseSettings,
    *,
    joined: bool = True,
    corrections: Corrections | None = None,
    stored: bool = False,
    explain: Callable[[str], None] | None,
    announce: Callable[[Plan], None] | None,
) -> ReadyFrame:
    """What fusion and alignment have in common: all that comes before alpha's pixels are matched.

    Arguments are as of `fuse`; without a network that of the shipped weights for bands as the betas'.
    `joined` takes co-located betas for one of several bands. Raises as `fuse`.
    """
    say = explain or (lambda line: None)
    views = Views.of(rig, images, alpha=alpha, depth=settings.depth, field=settings.field)
    views, low_light = denoised_views(views, settings.noise)
    if network is None:
        weights = weights_for([len(views.images[name]) for name in views.betas])
        network = load_weights(weights)
        say(f"weights: {weights}")
    check_bands(views, network.bands)
    if settings.noise == "auto" and low_light.noisy:
        say(low_light.described())
    betas, in_colour = views.betas, views.alpha_in_colour
    steps = steps_for(network, normalise=settings.match_levels, joined=joined)
    inputs, undo = prepared(network, views, steps)
    held = bytes_beside(inputs.inputs, [views.own, *(images.values() if isinstance(images, dict) else ())])
    del views  # whose images are there again, padded
    LOG.info("planning")
    align = settings.align is not False
    plan = plan_frame(
        network,
        inputs,
        limit=settings.limit,
        estimate=announce is not None,
        stored=stored,
        before=0.0 if corrections else expected_work(inputs, settings.response, align=align),
        after=low_light.seconds_left,
        kept=held + low_light.kept(inputs.hw, len(betas)),
    )
    if announce:
        announce(plan)
    fitted = corrections or find_corrections(network, inputs, settings.response, align=align)
    for line in fitted.described(inputs.hw):
        say(line)
    inputs = inputs._replace(inputs=fitted.applied(inputs.inputs, inputs.hw))
    return ReadyFrame(network, inputs, undo, plan, fitted, low_light, in_colour)


def _check_gradients(differentiable: bool, *, in_parts: bool, noisy: bool) -> None:
    """Raise for what has no gradients: ValueError if they are asked for, and within `torch.func`."""
    if differentiable and in_parts:
        raise ValueError("differentiable=True fuses the whole frame at once: leave out max_memory and store")
    if differentiable and noisy:
        raise ValueError("differentiable=True has no gradients through denoising: leave out noise")
    if transformations():
        raise NotImplementedError(
            "fuse has no gradients by torch.func: ask for them by differentiable=True and torch.autograd"
        )


def _with_rig(
    network: Any,
    rig: Rig | None,
    images: Images | None,
    alpha: str | None,
    explain: Callable[[str], None] | None,
) -> tuple[FusionNetwork, Rig, Images, str, bool]:
    """Network, rig, images, alpha, and whether to match levels; all found where the first is images alone."""
    if (
        isinstance(network, FusionNetwork)
        and isinstance(rig, Rig)
        and images is not None
        and alpha is not None
    ):
        return network, rig, images, alpha, False
    if rig is not None or images is not None or not isinstance(network, Mapping | Sequence):
        raise TypeError(
            'fuse takes a network, a rig, images and alpha=NAME, such as `load_weights("mono-colour")`, '
            "`Rig.load(FILE)` and {NAME: read_image(FILE)}; or images alone, to find the rig"
        )
    from ..app.from_images import array_from_images

    array = array_from_images(network, alpha=alpha, say=explain or (lambda line: None))
    return load_weights(array.weights), array.rig, array.images, array.alpha, array.match_levels


@torch_in_one_thread()
@without_autocast()
def corrections_of(
    network: FusionNetwork,
    rig: Rig,
    images: Images,
    *,
    alpha: str,
    settings: FuseSettings = FuseSettings(),
    **changes: Any,
) -> Corrections:
    """What `fuse` finds and corrects before it fuses; give it to `fuse` for other frames of the same cameras.

    Arguments and errors are as of `fuse`.
    """
    settings = _given(FuseSettings, settings).changed(changes)
    views = Views.of(rig, images, alpha=alpha, depth=settings.depth, field=settings.field)
    views, _ = denoised_views(views, settings.noise)
    check_bands(views, network.bands)
    inputs, _ = prepared(network, views, steps_for(network, normalise=settings.match_levels))
    return find_corrections(network, inputs, settings.response, align=settings.align is not False)


def _given(kind: type[T], value: T) -> T:
    """The value, if it is of this kind. Raises TypeError."""
    if not isinstance(value, kind):
        raise TypeError(f"wanted {kind.__name__}, got a {type(value).__name__}")
    return value


def matches_by(matcher: Matcher, inputs: Inputs) -> Matches:
    """What a matcher finds. Raises TypeError or ValueError for what are no matches of these inputs."""
    matches = _given(Matches, matcher(inputs))
    matches.check(inputs)
    return matches
