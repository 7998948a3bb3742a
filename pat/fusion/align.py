"""Each beta's own values at alpha's pixels, by fusion's matches, and where they are seen; no fused image.

Values are those that the cameras recorded, resampled once, at sub-pixel positions: no luminance of alpha and
no colour of a network is in them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeGuard

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import DTypeLike, NDArray
from torch import Tensor

from arraygeom import Band, LensView, Rig, Segments, View, pixel_grid, sample
from arraygeom.rig import with_pixels
from arraygeom.runtime.chunks import chunked
from arraygeom.runtime.threads import torch_in_one_thread
from arraygeom.sampling import Interpolation, on_image
from arraygeom.undistortion import pixels_between, recorded_pixels, resampled

from ..matching.inputs import BetaMatches
from ..matching.match import Matcher, match
from ..media.images import Images
from ..networks.protocol import FusionNetwork
from ..support.blocks import without_autocast
from ..support.memory import limited
from .checks import warn_of_confidence
from .fuse import FuseSettings, Progress, matches_by, ready_frame
from .inputs import FrameInputs, Placement
from .steps import has_lens, undone
from .tiles import Plan, fused_in_tiles

LOG = logging.getLogger(__name__)

Resampling = Literal["nearest", "bilinear", "cubic"]
Fill = Literal["none", "propagate"]
INTERPOLATIONS: dict[str, Interpolation] = {"nearest": "nearest", "bilinear": "bilinear", "cubic": "bicubic"}

OUTSIDE, OCCLUDED, SEEN = 0, 1, 2
"""Visibility of alpha's pixels in a beta: beyond its edge; occluded or unmatched (low confidence); seen."""

LEAST_CONFIDENCE = 0.5
"""Confidence from which a point counts as seen: the position is more likely right than not. Some occluded
pixels exceed it: docs/reports/alignment.md, under "occluded pixels filled"."""

SMOOTH = 1.0
"""Largest difference, pixels, of disparity between alpha's pixels from the nearest one's: more is an edge."""

Recorded = Mapping[str, Any]
"""Values (C, H, W) by camera, as recorded: NumPy arrays of any type, or tensors."""


@dataclass(frozen=True)
class AlignedView:
    """One camera's values at alpha's H x W pixels; `numpy.asarray` gives the values. Alpha's own are all
    seen, with confidence 1.

    Attributes:
        values: (C, H, W), in the recorded type; 0 (NaN for floats) where the camera does not see the point,
            unless filled.
        positions: (H, W, 2), float32, positions of alpha's pixels in the recorded image (x, y); NaN beyond
            its edge.
        visibility: (H, W), uint8, `OUTSIDE`, `OCCLUDED` or `SEEN`.
        confidence: (H, W), float32: probability that this camera sees the point at this position, 0 to 1; 0
            beyond its edge.
        bands: name of each channel of the values: the camera's; NAME.red, NAME.green and NAME.blue for three;
            NAME.1 and so on for others.
        response: spectral response of the sensor; None if the rig does not state it.
    """

    values: NDArray[Any]
    positions: NDArray[np.float32]
    visibility: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    bands: tuple[str, ...]
    response: Any = None

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Mask (H, W) of the pixels whose point the camera sees."""
        return self.visibility == SEEN

    @property
    def wavelengths(self) -> tuple[float | None, ...]:
        """Centres of the bands in nanometres; None where the rig does not state them."""
        centre = self.response.centre if isinstance(self.response, Band) else None
        return (centre,) * len(self.bands)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self.values, dtype=dtype) if copy else np.asarray(self.values, dtype=dtype)


@dataclass(frozen=True)
class Aligned(Mapping[str, AlignedView]):
    """All cameras' own values at the pixels of one: a mapping of names to views, that of `alpha` first.

    Attributes:
        alpha: name of the camera at whose pixels all values are.
        views: view of each camera.
        depth: (H, W), float32: depth along alpha's axis, or its rays (`measured_along`), in the rig's unit;
            NaN where unknown.
    """

    alpha: str
    views: Mapping[str, AlignedView]
    depth: NDArray[np.float32]

    def __getitem__(self, name: str) -> AlignedView:
        return self.views[name]

    def __iter__(self) -> Any:
        return iter(self.views)

    def __len__(self) -> int:
        return len(self.views)

    @property
    def bands(self) -> tuple[str, ...]:
        """Names of all bands, those of alpha first."""
        return tuple(band for view in self.views.values() for band in view.bands)

    @property
    def wavelengths(self) -> tuple[float | None, ...]:
        """Centres of all bands in nanometres; None where the rig does not state them."""
        return tuple(wave for view in self.views.values() for wave in view.wavelengths)

    def band(self, name: str) -> NDArray[Any]:
        """Return one band (H, W) by name, a view of its camera's values.

        Raises:
            KeyError: for an unknown name; the text lists the bands.
        """
        for view in self.views.values():
            if name in view.bands:
                return view.values[view.bands.index(name)]
        raise KeyError(f"no band '{name}' (there are: {', '.join(self.bands)})")

    def stack(self) -> NDArray[Any]:
        """Return all bands (bands, H, W), in the type that holds all."""
        return np.concatenate([view.values for view in self.views.values()])


@torch_in_one_thread()
@without_autocast()
def align_frame(
    images: Images,
    rig: Rig,
    *,
    alpha: str,
    network: FusionNetwork,
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
    """Bring every camera's own values to the pixels of camera `alpha`, for a rig that is known.

    `pat.align` calls it, and describes the settings, warnings and the alignment.

    Args:
        images: tensors by camera name, (C, H, W) in 0..1, which are matched.
        rig: the cameras. Those without an image are left out.
        alpha: name of the camera whose pixels are kept.
        network: network that uses matches.
        settings: settings of fusion; `keep_alpha` and `luminance` are not used.
        recorded: values to resample, of the images' sizes; None for the images themselves.
        interpolation: "nearest", "bilinear" or "cubic", of the values.
        min_confidence: confidence below which a pixel counts as occluded.
        fill: "none" for 0 or NaN where a camera does not see the point, "propagate" for the nearest value.
        explain: function that is called with lines about what was corrected; None for none.
        progress: function that wraps the tiles to show progress; None for none.
        announce: function that is called with the plan; None for none.
        matcher: function from inputs to matches.

    Returns:
        Values, masks and positions by camera, with alpha's depth: NumPy arrays, without gradients.

    Raises:
        ValueError: as `ready_frame`; for a network or matches that do not serve, other words or numbers for
            `interpolation`, `fill` and `min_confidence`, and recorded values that are missing, no numbers, or
            of another size. Images that are read when asked for raise as their mapping does.
        TypeError: as `ready_frame`, and for what `matcher` returns if that is no `Matches`.
    """
    rule = _ViewRule(interpolation, min_confidence, fill)
    rig = with_pixels(rig)
    betas = [name for name in rig.betas(alpha) if name in images]
    recordings = images if recorded is None else recorded
    _check_recorded(rig, recordings, (alpha, *betas))
    if not network.uses_matches:
        raise ValueError("these weights use no matches to align by: take others, such as mono-spectral")
    inputs, undo, plan, *_ = ready_frame(
        images, rig, alpha, network, settings, joined=False, explain=explain, announce=announce
    )
    with limited(settings.limit), torch.no_grad():
        matches = matches_by(matcher, inputs.inputs)
        fused = fused_in_tiles(network, inputs, matches, plan.tiles, progress=progress)
        warn_of_confidence(network, fused.frame, inputs)
        depths = undone(fused.frame, undo).depth
        aligned = {alpha: _own_view(rig[alpha], alpha, recordings[alpha])}
        for i, name in enumerate(betas):
            LOG.info("aligning %s", name)
            place = inputs.placements[i]
            located = _located(inputs, i, matches.betas[i], rig[alpha])
            confidence = _as_recorded(fused.matched[i, 2:], place.pair.alpha, rig[alpha])
            values = _as_array(recordings[name], name, rig[name].hw)
            aligned[name] = rule.view(rig[name], name, place, located, confidence, values)
    return Aligned(alpha, aligned, depths.cpu().numpy())


def _check_recorded(rig: Rig, recordings: Recorded, names: Iterable[str]) -> None:
    """Raise ValueError unless there are values of all these cameras, of the sizes that the rig states."""
    for name in names:
        if name not in recordings:
            raise ValueError(
                f"there are no recorded values of '{name}': give those of every camera with an image"
            )
        if isinstance(recordings, dict):  # others may be read from files, which takes time
            _as_array(recordings[name], name, rig[name].hw)


def _as_recorded(confidence: Float[Tensor, "1 h w"], now: View, recorded: View) -> Float[Tensor, "h2 w2"]:
    """Return confidence at alpha's recorded pixels; 0 where alpha's undistorted view has none."""
    if _is_undistorted(recorded, now):
        assert isinstance(now, LensView)
        confidence = resampled(confidence, now, recorded, interpolation="bilinear").values[0]
    return confidence[0]


def _located(
    inputs: FrameInputs, i: int, matches: BetaMatches, recorded: View
) -> tuple[Float[Tensor, "h w 2"], Bool[Tensor, "h w"]]:
    """Return positions of alpha's recorded pixels in the i-th beta as prepared, and a mask of those on it."""
    h, w = inputs.hw
    beta, pinhole = inputs.inputs.betas[i], inputs.placements[i].pair.alpha
    hw = (beta.image.shape[-2], beta.image.shape[-1])
    if not _is_undistorted(recorded, pinhole):
        where, inside = matches.positions(beta.field.straight, hw)
        return where[0, :h, :w], inside[0, :h, :w]
    assert isinstance(pinhole, LensView)
    x, valid = pixels_between(pinhole, recorded)
    disparity = _between_pixels(matches.surface[0, :, :h, :w], x)

    def at_points(x: Float[Tensor, "h w 2"], disparity: Float[Tensor, "h w"]) -> tuple[Tensor, Tensor]:
        segments, rows = beta.field.at(x.reshape(-1, 2)), (1, *x.shape[:2])
        assert isinstance(segments, Segments)
        parts = segments.start.reshape(*rows, 2), segments.end.reshape(*rows, 2), segments.valid.reshape(rows)
        bare = replace(matches, disparity=disparity[None, None], chosen=None)
        where, inside = bare.positions(Segments(*parts), hw)
        return where[0], inside[0]

    where, inside = chunked(at_points, x, disparity, axis=0)
    return where, inside & valid


def _is_undistorted(recorded: View, now: View) -> TypeGuard[LensView]:
    """Return True if a camera's image was undistorted: some are fused as they recorded."""
    return has_lens(recorded) and not has_lens(now)


def _between_pixels(disparity: Float[Tensor, "1 h w"], x: Float[Tensor, "h2 w2 2"]) -> Float[Tensor, "h2 w2"]:
    """Return disparity between pixels: interpolated within surfaces, the nearest at depth edges."""
    nearest, smooth = (
        sample(disparity[None], x[None], interpolation=kind, extended=True).values[0, 0]
        for kind in ("nearest", "bilinear")
    )
    return torch.where((smooth - nearest).abs() < SMOOTH, smooth, nearest)


def _own_view(camera: View, name: str, recorded: Any) -> AlignedView:
    """Return alpha's own values, all of them seen at their own pixels."""
    hw, values = camera.hw, _as_array(recorded, name, camera.hw)
    planes = pixel_grid(hw).numpy(), np.full(hw, SEEN, np.uint8), np.ones(hw, np.float32)
    return AlignedView(values, *planes, _band_names(name, len(values)), camera.sensor.response)


@dataclass(frozen=True)
class _ViewRule:
    """Rule by which a beta's values are resampled, and confidence from which they count as seen."""

    interpolation: Resampling
    min_confidence: float
    fill: Fill

    def __post_init__(self) -> None:
        if self.interpolation not in INTERPOLATIONS or self.fill not in ("none", "propagate"):
            raise ValueError(
                "interpolation is nearest, bilinear or cubic, and fill none or propagate; "
                f"got {self.interpolation}, {self.fill}"
            )
        if not 0 <= self.min_confidence <= 1:
            raise ValueError(f"the least confidence is {self.min_confidence:g}: give a number from 0 to 1")

    def view(
        self,
        camera: LensView,
        name: str,
        place: Placement,
        located: tuple[Float[Tensor, "h w 2"], Bool[Tensor, "h w"]],
        confidence: Float[Tensor, "h w"],
        values: NDArray[Any],
    ) -> AlignedView:
        """Resample a beta's recorded values (C, hb, wb) to alpha's pixels.

        Args:
            camera: the beta as recorded.
            name: its name.
            place: its relation to alpha, as prepared for matching.
            located: positions of alpha's pixels in the prepared beta, with a mask of those on it.
            confidence: confidence of each position, 0 to 1.
            values: the recorded values.
        """
        now = place.pair.beta
        assert isinstance(now, LensView)
        where, valid = chunked(lambda x: recorded_pixels(x, now, camera), located[0].double(), axis=0)
        visible, where = (confidence >= self.min_confidence).cpu(), where.float().cpu()
        inside = (located[1] & valid).cpu() & on_image(where, camera.hw)
        seen = torch.where(inside, torch.where(visible, SEEN, OCCLUDED), OUTSIDE)
        visibility = seen.to(torch.uint8).numpy()
        taken = resampled_values(values, where.numpy(), self.interpolation)
        return AlignedView(
            filled(taken, visibility == SEEN, self.fill),
            torch.where(inside[..., None], where, torch.nan).numpy(),
            visibility,
            torch.where(inside, confidence.float().cpu(), 0.0).numpy(),
            _band_names(name, len(values)),
            camera.sensor.response,
        )


def _as_array(values: Any, name: str, hw: tuple[int, int]) -> NDArray[Any]:
    """Return recorded values as a NumPy array.

    Raises:
        ValueError: for another shape than (C, H, W), and for values that are no numbers.
    """
    if isinstance(values, Tensor):
        values = values.detach().cpu()
        values = values.float() if values.dtype == torch.bfloat16 else values  # which NumPy has not
    array = np.asarray(values)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"the recorded values of '{name}' are {array.dtype}: give integers or real numbers")
    if array.ndim != 3 or array.shape[1:] != tuple(hw):
        (h, w), got = hw, "x".join(map(str, array.shape))
        raise ValueError(
            f"the recorded values of '{name}' are {got}, the rig says (C, {h}, {w}): give the whole image"
        )
    return array


def _band_names(name: str, count: int) -> tuple[str, ...]:
    if count == 1:
        return (name,)
    return tuple(f"{name}.{band}" for band in ("red", "green", "blue") * (count == 3) or range(1, count + 1))


def resampled_values(
    values: NDArray[Any], positions: NDArray[np.float32], interpolation: Resampling
) -> NDArray[Any]:
    """Resample recorded values (C, H, W) at positions (h, w, 2), pixels (x, y), in float64.

    Returns:
        Values (C, h, w) in the type given, integers rounded and clipped to it; 0 beyond the edge and at NaN.

    Raises:
        ValueError: for another word as `interpolation`.
    """
    if interpolation not in INTERPOLATIONS:
        raise ValueError(f"interpolation is {interpolation!r}: wanted {', '.join(INTERPOLATIONS)}")
    kind, where = INTERPOLATIONS[interpolation], torch.from_numpy(positions)

    def sampled(plane: NDArray[Any]) -> NDArray[np.float64]:
        image = torch.from_numpy(plane.astype(np.float64))[None, None]
        taken = chunked(
            lambda x: sample(image, x[None].double(), interpolation=kind).values[0, 0], where, axis=0
        )
        return taken.numpy()

    if interpolation == "nearest":
        numbers = 1 + np.arange(values[0].size).reshape(values[0].shape)
        which = sampled(numbers).astype(np.int64)
        return np.where(which > 0, values.reshape(len(values), -1)[:, which - 1], np.zeros((), values.dtype))
    if values.dtype.kind == "b":
        return resampled_values(values.view(np.uint8), positions, interpolation) > 0
    if values.dtype.kind not in "iu":
        return np.stack([sampled(plane).astype(values.dtype) for plane in values])
    limits = np.iinfo(values.dtype)
    most = np.nextafter(float(limits.max), 0) if limits.bits > 53 else limits.max
    return np.stack([np.clip(np.rint(sampled(p)), limits.min, most).astype(values.dtype) for p in values])


def filled(values: NDArray[Any], valid: NDArray[np.bool_], fill: Fill) -> NDArray[Any]:
    """Replace invalid values (C, H, W) by 0 (NaN for floats), or by those of the nearest valid pixel.

    Args:
        fill: "none" for 0 or NaN, "propagate" for the nearest valid value.
        valid: mask (H, W) of the valid pixels.

    Returns:
        Values (C, H, W) of the same type; 0 or NaN everywhere if no pixel is valid.
    """
    if fill == "none" or not valid.any():
        nothing = np.nan if np.issubdtype(values.dtype, np.floating) else 0
        return np.where(valid, values, np.asarray(nothing, values.dtype))
    how = cv2.DIST_L2, cv2.DIST_MASK_PRECISE
    _, labels = cv2.distanceTransformWithLabels((~valid).view(np.uint8), *how, labelType=cv2.DIST_LABEL_PIXEL)
    nearest = np.zeros(labels.max() + 1, np.int64)
    nearest[labels[valid]] = np.flatnonzero(valid)
    return values.reshape(len(values), -1)[:, nearest[labels]]
