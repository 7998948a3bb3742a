"""Front door: `fuse` and `align`, for images alone or with their rig, as files or tensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from torch import Tensor

from arraygeom import Rig
from arraygeom.runtime.threads import torch_in_one_thread

from ..fusion.align import LEAST_CONFIDENCE, Aligned, Fill, Recorded, Resampling, align_frame
from ..fusion.corrections import Corrections
from ..fusion.frame import Frame
from ..fusion.fuse import FuseSettings, Progress, fuse_frame
from ..fusion.tiles import Plan
from ..fusion.views import ViewFiles
from ..matching.match import Matcher, match
from ..media.images import Images, ImageSources
from ..networks.protocol import FusionNetwork
from ..networks.weights import load_weights, weights_for
from ..support.blocks import without_autocast

P, T = ParamSpec("P"), TypeVar("T")


def _images_first(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator that raises a TypeError, which says the order, for a network or a rig in the
    images' place."""

    @wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> T:
        if len(args) > 2 or (args and isinstance(args[0], FusionNetwork | Rig)):
            name = function.__name__
            raise TypeError(f"images come first, then the rig: {name}(images, rig, alpha=NAME, network=...)")
        return function(*args, **kwargs)

    return checked


@_images_first
@torch_in_one_thread()
@without_autocast()
def fuse(
    images: ImageSources,
    rig: Rig | str | Path | None = None,
    *,
    alpha: str | None = None,
    network: FusionNetwork | str | Path | None = None,
    settings: FuseSettings = FuseSettings(),
    corrections: Corrections | None = None,
    explain: Callable[[str], None] | None = None,
    progress: Progress | None = None,
    announce: Callable[[Plan], None] | None = None,
    store: Path | None = None,
    differentiable: bool = False,
    matcher: Matcher = match,
) -> Frame:
    """Fuse one frame at camera `alpha`'s view.

    Without a rig one is estimated from the images as by `pat fuse`, noise that shows plainly is removed (not
    with `differentiable` or another `luminance`), and depths are multiples of the baseline. Frames too large
    for the memory allowed are fused in tiles of alpha, each with the part of every beta that its segments
    touch, and a halo: equal to the whole to 1e-4. Distorted images are first resampled to pinhole views,
    rotated betas made upright, and betas resized to alpha's angular resolution; the result is at alpha's own
    pixels all the same. Where alpha is known to measure the luminance of linear light and one beta the
    colours, the result is as bright in that sense (`pat.media.raw.match_luminance`).

    Args:
        images: an image of each camera by name: a dict of files or tensors (C, H, W) in 0..1; or files alone,
            which name the cameras. Another mapping, which reads its tensors when asked, saves memory.
        rig: the cameras, or their file. Those without an image are left out. Files are developed as it says.
        alpha: the camera whose view is wanted; without a rig by default the largest grey image, else the
            largest.
        network: weights by name or file, or a network; by default "mono-colour" for betas in colour (without
            a rig also for one of them, or three called red, green, blue), else "mono-spectral".
        settings: settings that frames of the same cameras have in common.
        corrections: response and alignment estimated from another frame of the same cameras
            (`corrections_of`); None to estimate them from this one.
        explain: function that is called with a line of text for each detected and corrected problem; None for
            none.
        progress: function of the tiles and their number that yields the tiles, to show progress; None for
            none.
        announce: function that is called with the plan before the work begins; the time of a large frame is
            then estimated by fusing a part. None for none.
        store: folder for finished tiles of a frame of several, so that one that was stopped goes on; tiles of
            other images, rigs or weights are not taken. The caller deletes it. None for none.
        differentiable: True to keep gradients with respect to the numbers of the rig, the images and the
            network's weights (which `requires_grad_(True)` frees). A match moves along its segment as images
            and rig move the best agreement around it; which match is the best, the alignment and the response
            are constants, and so is what enters or leaves a beta's image: leave its border out of an error.
            `pat.fusion.gradients.without_gradient` names the parameters without a gradient. False to detach
            the frame, whatever requires gradients.
        matcher: function from inputs to matches, for a network that uses them: `pat.matching.match.match`, or
            your own.

    Returns:
        The frame of alpha: fused image, depth and confidence at alpha's own pixels.

    Raises:
        ValueError: a camera that the rig lacks, an image of another size, files that cannot be used, a rig
            whose views do not overlap, bands that the network does not make, settings that contradict each
            other, a memory limit that is too small, `differentiable` with a memory limit, `store` or noise;
            without a rig, what `array_from_images` refuses; with one, no `alpha`.
        TypeError: arguments in the wrong order or of another type.
        NotImplementedError: within a transformation of `torch.func`.
        FileNotFoundError: a missing file, or weights of an unknown name.

    Warns:
        LowConfidenceWarning: the images hardly match: the rig is probably wrong. A filter makes it an error,
            as `warnings.simplefilter("error", LowConfidenceWarning)`. Lesser doubts are a UserWarning.
    """
    known = _known(images, rig, alpha, network, settings, explain)
    if rig is None and settings.luminance == "alpha" and not differentiable and settings.noise is None:
        known["settings"] = replace(known["settings"], noise="auto")
    return fuse_frame(
        **known,
        corrections=corrections,
        progress=progress,
        announce=announce,
        store=store,
        differentiable=differentiable,
        matcher=matcher,
    )


@_images_first
@torch_in_one_thread()
@without_autocast()
def align(
    images: ImageSources,
    rig: Rig | str | Path | None = None,
    *,
    alpha: str | None = None,
    network: FusionNetwork | str | Path | None = None,
    settings: FuseSettings = FuseSettings(),
    recorded: Recorded | None = None,
    interpolation: Resampling = "bilinear",
    min_confidence: float = LEAST_CONFIDENCE,
    fill: Fill = "none",
    explain: Callable[[str], None] | None = None,
    progress: Progress | None = None,
    announce: Callable[[Plan], None] | None = None,
    matcher: Matcher = match,
) -> Aligned:
    """Bring every camera's own values to the pixels of camera `alpha`.

    Arguments that are not listed here are as for `fuse`; of the settings `keep_alpha` and `luminance` have no
    effect. Images, rig and network find the positions of alpha's pixels in each beta. A pixel counts as
    occluded if the confidence that beta sees its point is low.

    Args:
        images: image of each camera, as for `fuse`.
        rig: rig or its file; None to find it from the images.
        alpha: camera to align to; None for the camera that `fuse` takes.
        network: network whose confidence is used, which must use matches; None for the default.
        recorded: values to align by camera, (C, H, W) of any type, as large as the images; None for the
            images.
        interpolation: "nearest" keeps recorded values; "bilinear" and "cubic" interpolate, rounded for
            integers.
        min_confidence: confidence, 0 to 1, from which a camera counts as seeing a point.
        fill: "none" leaves 0, or NaN in floats, where a camera does not see the point; "propagate" takes its
            nearest seen value.

    Returns:
        Values, masks and positions of alpha and each beta by name, with alpha's depth, as NumPy arrays.

    Raises:
        ValueError: for what `fuse` refuses, a network that uses no matches, options other than these, and
            recorded values that are missing, no numbers, or of another size than the rig says.
        TypeError: for arguments in the wrong order or of another type.
        FileNotFoundError: for a missing file, or weights of an unknown name.
    """
    return align_frame(
        **_known(images, rig, alpha, network, settings, explain),
        recorded=recorded,
        interpolation=interpolation,
        min_confidence=min_confidence,
        fill=fill,
        progress=progress,
        announce=announce,
        matcher=matcher,
    )


def _known(
    images: ImageSources,
    rig: Rig | str | Path | None,
    alpha: str | None,
    network: FusionNetwork | str | Path | None,
    settings: FuseSettings,
    explain: Callable[[str], None] | None,
) -> dict[str, Any]:
    """Arguments of `fuse_frame` and `align_frame` by name: as given, or found."""
    if not isinstance(settings, FuseSettings):
        raise TypeError(f"settings are a {type(settings).__name__}: give FuseSettings(depth=..., noise=...)")
    shown: Images
    say = explain or (lambda line: None)
    if rig is None:
        from .from_images import array_from_images

        weights = str(network) if isinstance(network, str | Path) else None
        array = array_from_images(images, alpha=alpha, weights=weights, say=say)
        settings = replace(settings, match_levels=settings.match_levels or array.match_levels)
        shown, rig, alpha = array.images, array.rig, array.alpha
        network = array.weights if network is None else network
    else:
        rig = Rig.load(rig) if isinstance(rig, str | Path) else rig
        if not isinstance(rig, Rig):
            raise TypeError(f"the rig is a {type(rig).__name__}: give a Rig, or its file")
        if alpha is None:
            raise ValueError(f"alpha: give the camera whose view is wanted, one of {', '.join(rig.names)}")
        shown, rig = _with_images(images, rig, rig.require(alpha))
    if network is None:
        betas = (shown[name] for name in rig.betas(alpha) if name in shown)
        network = weights_for([len(image) for image in betas if isinstance(image, Tensor)])
        say(f"network: {network}")
    network = load_weights(network) if isinstance(network, str | Path) else network
    if not isinstance(network, FusionNetwork):
        raise TypeError(f"network is a {type(network).__name__}: give weights by name or file, or a network")
    named = {"images": shown, "rig": rig, "alpha": alpha, "network": network}
    return {**named, "settings": settings, "explain": explain}


def _with_images(images: ImageSources, rig: Rig, alpha: str) -> tuple[Images, Rig]:
    """Images, files developed as the rig says, and the rig that describes them."""
    if not isinstance(images, Mapping):
        from .from_images import by_camera

        images = by_camera(images)
    # a mapping that is no dict reads its images when asked
    files = {n: x for n, x in images.items() if isinstance(x, str | Path)} if isinstance(images, dict) else {}
    if not files:
        return images, rig
    for name in files:
        rig.require(name)
    views = ViewFiles(rig, files, alpha=alpha)
    return {**images, **views}, views.developed
