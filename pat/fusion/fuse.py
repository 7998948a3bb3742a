"""Whole frames: a rig and one image a camera in, one fused image out."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from arraygeom import ReceptiveField, Rig
from arraygeom.runtime.chunks import Tile
from arraygeom.runtime.threads import torch_in_one_thread
from arraygeom.runtime.tracing import transformations
from arraygeom.runtime.warned import warn

from ..matching.band_mix import ResponseSpec, given_response
from ..matching.inputs import Inputs, Matches
from ..matching.match import Matcher, match
from ..media.images import Images
from ..networks.protocol import FusionNetwork
from ..support.blocks import without_autocast
from ..support.memory import LEAST_BYTES, LEAST_MATCHED, check_limit, limited, parse_bytes, planned
from .checks import warn_of_confidence
from .corrections import Corrections, expected_work, find_corrections
from .depth_filling import final_depth
from .frame import Frame
from .inputs import FrameInputs, bytes_beside, prepared
from .low_light import LowLight, Noise, check_noise, denoised_views
from .luminance import SHARES, Luminance, check_luminance, with_alpha_detail, with_own_colours
from .steps import Undo, steps_for, undone
from .tiles import LARGE, Plan, fused_in_tiles, plan_frame
from .views import Views, check_bands, check_dense

LOG = logging.getLogger(__name__)
T = TypeVar("T")

Progress = Callable[[Iterable[Tile], int], Iterable[Tile]]
"""Function that wraps the tiles (and their number) to show progress, as `rich.progress.track` does."""


@dataclass(frozen=True)
class FuseSettings:
    """Settings of fusion that one frame, many and a sequence have in common.

    Attributes:
        depth: (near, far) in the rig's unit, in place of the rig's; None for the rig's.
        field: receptive field, or one for each of some betas, by name; None for `arraygeom`'s
            `default_field`.
        max_memory: limit of memory in bytes, or like "4GiB": of the whole process, libraries and images
            included, if nothing else runs in it; None for no limit.
        match_levels: True to bring each beta to alpha's mean and standard deviation first, for cameras whose
            exposures or filters differ and which are not radiometrically calibrated.
        response: weights in alpha of the RGB betas' red, green and blue. "fit" fits them to matches, with
            gain, gamma and vignetting, and leaves them at Rec. 601 luma ("rec601") where that explains the
            images as well; three numbers, or a `Response`, state them. The result has alpha as this
            combination of its colours.
        align: True to estimate the betas' distance across their search segments, and correct it; None for
            True unless the fusion is differentiable, where a corrected rig has no gradient of its error.
        noise: noise level of each camera that has some, or "estimate": views are denoised before they are
            matched, and jointly after they are fused. "auto" does so only if an image shows noise plainly.
            None for no denoising; but `pat.fuse` without a rig takes None for "auto", and only {} for none.
        keep_alpha: True to leave alpha's values as recorded, noise included; as is done too if alpha has no
            noticeable noise.
        luminance: luminance of the image: "alpha", exact by networks with `keeps_luminance`, "beta", in
            alpha's detail, where alpha sees another part of the spectrum, or their "mix".

    Raises:
        ValueError: for a noise or a response of another kind; the rest is checked when it is used.
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
        """Memory limit in bytes; None for none."""
        return None if self.max_memory is None else parse_bytes(self.max_memory)


@torch_in_one_thread()
@without_autocast()
def fuse_frame(
    images: Images,
    rig: Rig,
    *,
    alpha: str,
    network: FusionNetwork,
    settings: FuseSettings = FuseSettings(),
    corrections: Corrections | None = None,
    explain: Callable[[str], None] | None = None,
    progress: Progress | None = None,
    announce: Callable[[Plan], None] | None = None,
    store: Path | None = None,
    differentiable: bool = False,
    matcher: Matcher = match,
) -> Frame:
    """Fuse one frame at camera `alpha`'s view, for a rig that is known.

    `pat.fuse` calls it, and describes the other arguments and the warnings.

    Args:
        images: tensors by camera name, (C, H, W) in 0..1, each of the size that the rig states. A mapping
            that reads them when asked saves memory (`pat.fusion.views.ViewFiles`).
        rig: the cameras. Those without an image in `images` are left out.
        corrections: response and misalignments to apply; None to estimate them.
        explain: function that is called with lines about what was corrected; None for none.
        progress: function that wraps the tiles to show progress; None for none.
        announce: function that is called with the plan; None for none.
        store: folder of finished tiles, if there are several, from which a stopped fusion goes on; None for
            none.
        differentiable: True to keep gradients; by default the frame has none.
        matcher: function that matches, instead of `match`.

    Returns:
        The frame at alpha's pixels.

    Raises:
        ValueError: as `ready_frame`; for settings that contradict each other or `differentiable`, and matches
            that `Matches.check` refuses. Images, fields and matcher raise their own errors too.
        NotImplementedError: within a transformation of `torch.func`.
        TypeError: for images, settings, corrections, fields or matches of another type.
        OSError: if a finished tile cannot be written to `store`.
    """
    given = of_kind(FuseSettings, settings).align
    settings = replace(settings, align=not differentiable if given is None else given)
    in_parts, luminance = settings.max_memory is not None or store is not None, settings.luminance
    _check_gradients(differentiable, in_parts=in_parts, noisy=bool(settings.noise))
    check_luminance(network, luminance, noisy=settings.noise is not None)
    inputs, undo, plan, fitted, low_light, in_colour = ready_frame(
        images,
        rig,
        alpha,
        network,
        settings,
        corrections=None if corrections is None else of_kind(Corrections, corrections),
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
        depth = final_depth(fused.frame, inputs)
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
    """Inputs of a frame that is ready to be matched, and the rest that its fusion needs.

    Attributes:
        inputs: the network's inputs, corrected.
        undo: functions that take a frame of these back to alpha's pixels.
        plan: the plan of the fusion.
        corrections: the corrections made, found or given.
        low_light: views before and after denoising; without images if none had noticeable noise.
        in_colour: True if alpha's image was in colour.
    """

    inputs: FrameInputs
    undo: list[Undo]
    plan: Plan
    corrections: Corrections
    low_light: LowLight
    in_colour: bool


def ready_frame(
    images: Images,
    rig: Rig,
    alpha: str,
    network: FusionNetwork,
    settings: FuseSettings,
    *,
    joined: bool = True,
    corrections: Corrections | None = None,
    stored: bool = False,
    explain: Callable[[str], None] | None,
    announce: Callable[[Plan], None] | None,
) -> ReadyFrame:
    """Prepare a frame for fusion or alignment: all steps before alpha's pixels are matched.

    Views are denoised, undistorted and resized, tiles planned, and corrections estimated and applied.
    Arguments that are not listed are those of `fuse_frame`.

    Args:
        settings: settings of fusion; `align` None counts as True here.
        joined: True to join co-located betas to one of several bands.
        corrections: corrections to apply; None to estimate them.
        stored: True if finished tiles are stored on disk.
        explain: function that is called with lines about what was corrected; None for none.
        announce: function that is called with the plan; None for none.

    Returns:
        The prepared frame.

    Raises:
        ValueError: for images or settings that do not fit the rig or the network, views that do not overlap,
            corrections of other cameras, and a memory limit that is too small.
        TypeError: for images that are no tensors, an object that is no field, a depth range of no two, and
            settings of another type.
    """
    limit, say = of_kind(FuseSettings, settings).limit, explain or (lambda line: None)
    least = LEAST_MATCHED if network.uses_matches else LEAST_BYTES
    check_limit(math.prod(rig[rig.require(alpha)].hw), limit, least)
    views = Views.of(rig, images, alpha=alpha, depth=settings.depth, field=settings.field)
    check_dense(views, limit)
    views, low_light = denoised_views(views, settings.noise)
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
        limit=limit,
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
    return ReadyFrame(inputs, undo, plan, fitted, low_light, in_colour)


def _check_gradients(differentiable: bool, *, in_parts: bool, noisy: bool) -> None:
    """Raise ValueError for gradients that are not available, and NotImplementedError within `torch.func`."""
    if differentiable and in_parts:
        raise ValueError("differentiable=True fuses the whole frame at once: leave out max_memory and store")
    if differentiable and noisy:
        raise ValueError("differentiable=True has no gradients through denoising: leave out noise")
    if transformations():
        raise NotImplementedError(
            "fuse has no gradients by torch.func: ask for them by differentiable=True and torch.autograd"
        )


@torch_in_one_thread()
@without_autocast()
def corrections_of(
    images: Images, rig: Rig, *, alpha: str, network: FusionNetwork, settings: FuseSettings = FuseSettings()
) -> Corrections:
    """Estimate the corrections that `fuse` makes, to use them for other frames of the same cameras.

    Args:
        images: tensors by camera name, (C, H, W) in 0..1.
        rig: the cameras.
        alpha: name of alpha.
        network: network that will fuse.
        settings: settings of fusion; `response` and `align` (None for True) say what to estimate.

    Returns:
        The response and misalignments, which `fuse` takes as `corrections`.

    Raises:
        ValueError: as `ready_frame`.
        TypeError: as `ready_frame`.
    """
    return ready_frame(images, rig, alpha, network, settings, explain=None, announce=None).corrections


def of_kind(kind: type[T], value: T) -> T:
    """Return the value, if it is of this kind.

    Raises:
        TypeError: for another kind.
    """
    if not isinstance(value, kind):
        raise TypeError(f"wanted {kind.__name__}, got a {type(value).__name__}")
    return value


def matches_by(matcher: Matcher, inputs: Inputs) -> Matches:
    """Return the matches of inputs by a matcher, checked.

    Raises:
        TypeError: for a result of another type.
        ValueError: for matches that `Matches.check` refuses. The matcher's own errors pass.
    """
    matches = of_kind(Matches, matcher(inputs))
    matches.check(inputs)
    return matches
