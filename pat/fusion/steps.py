"""Steps applied to views before they are fused, and undone on the fused frame afterwards.

A step takes views and returns them changed, with a function that takes the fused frame back.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeGuard

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom import (
    Camera,
    Curved,
    LensView,
    Moved,
    Pair,
    ReceptiveField,
    Rig,
    ThroughLenses,
    View,
    Widened,
    pinhole_view,
    pixel_grid,
    resampled,
)
from arraygeom.fields.default import default_field
from arraygeom.fields.protocol import lazily
from arraygeom.fields.ray_depth import rough_transfer
from arraygeom.pixels import HW, coarse_grid, map_homogeneous, shift_matrix
from arraygeom.undistortion import pixels_between

from ..matching.inputs import box_around, ends_of
from ..matching.normalisation import Moments, moments, normalised
from ..media.images import Images
from ..media.raw import LIGHT, match_luminance
from ..networks.protocol import FusionNetwork, JoinsBands
from .frame import Frame
from .views import Fields, Views, innermost, states_distance

Undo = Callable[[Frame], Frame]


class StepResult(NamedTuple):
    """Result of a step that prepares views for fusion.

    Attributes:
        views: views after the step.
        undo: function that takes the fused frame back to the views before the step.
    """

    views: Views
    undo: Undo = lambda frame: frame


FusionStep = Callable[[Views], StepResult]


def steps_for(network: FusionNetwork, *, normalise: bool, joined: bool = True) -> list[FusionStep]:
    """List the steps that a network needs, in order.

    Args:
        normalise: True to bring betas to alpha's mean and standard deviation.
        joined: True to join co-located betas to one, False to keep each by itself.

    Returns:
        Functions from views to a `StepResult`: `undistort`, `linear_luminance` and `upright`; where wanted,
        `equal_resolution`, `normalise_betas` and `join`.
    """
    resize = [partial(equal_resolution, network)] if network.equal_resolution else []
    radiometry = [partial(normalise_betas, undone=not network.keeps_luminance)] if normalise else []
    together = [partial(join, network.joins_bands)] if joined else []
    return [undistort, linear_luminance, upright, *resize, *radiometry, *together]


def undistort(views: Views) -> StepResult:
    """Replace views with lenses by pinhole views, up to 62 degrees off axis.

    Unchanged if no camera has a lens or one has no pinhole view, or a field goes through lenses or bounds
    distances. Undone, a frame of an alpha with a lens is at alpha's own pixels: the fusion's difference from
    alpha is resampled and added to alpha's own image; outside the pinhole view confidence is 0, depth NaN.

    Returns:
        The views, and the function that undoes the step.

    Raises:
        ValueError: for an image without a pixel inside its lens's range, and a `Moved` field of another size
            than alpha's.
    """
    if not takes_pinhole_views(views):
        return StepResult(views)
    rig, images = without_lenses(views.rig, views.images)
    lens, pinhole = views.rig[views.alpha], rig[views.alpha]
    fields = {name: _for_pinhole(field, lens, pinhole) for name, field in views.fields.items()}
    straight, original = images[views.alpha], views.own
    undistorted = Views(rig, images, views.alpha, fields)
    return StepResult(undistorted, lambda frame: _distorted(frame, straight, original, pinhole, lens))


def takes_pinhole_views(views: Views) -> bool:
    """Return True if `undistort` changes views."""
    cameras = [views.rig[name] for name in views.images]
    fields = [innermost(field) for field in views.fields.values()]
    through_lenses = any(isinstance(f, Curved | ThroughLenses) or states_distance(f) for f in fields)
    return any(map(has_lens, cameras)) and all(c.has_pinhole_view for c in cameras) and not through_lenses


def linear_luminance(views: Views) -> StepResult:
    """Schedule the correction of luminance for an alpha that measured light; the views stay as they are.

    Undone, a frame of three bands has the luminance of light that alpha measured (`match_luminance`). For
    other alphas, and without a beta of three bands, nothing happens.

    Returns:
        The views, and the function that undoes the step.
    """
    alpha, sensor = views.own, views.rig[views.alpha].sensor
    if sensor.response != LIGHT or 3 not in [len(views.images[name]) for name in views.betas]:
        return StepResult(views)
    matched = partial(match_luminance, alpha=alpha, sensor=sensor)
    return StepResult(views, lambda f: f._replace(image=matched(f.image)) if len(f.image) == 3 else f)


def upright(views: Views) -> StepResult:
    """Rotate back betas, images and rig, that are rotated by about whole quarter turns against alpha.

    Returns:
        The views; there is nothing to undo.
    """
    for name in views.betas:
        if k := quarter_turns(views.pair(name)):
            rotated = views.images[name].rot90(k, (-2, -1))
            views = views.replace({name: rotated}, rig=views.rig.rot90(name, k))
    return StepResult(views)


def equal_resolution(network: FusionNetwork, views: Views) -> StepResult:
    """Resize betas to about alpha's angular resolution where views meet.

    Betas within a quarter of it keep their size; resized images are clipped to 0..1, of 16 pixels a side or
    more. A beta to be enlarged is first cropped to what search segments touch, if that is much smaller.

    Returns:
        The views; there is nothing to undo.

    Raises:
        ValueError: for an invalid result of a field, or whatever a field raises for its pair.
        TypeError: for an object that is no field.
    """
    for name in views.betas:
        views = _cropped(network, views, name)
        image = of_size(views.images[name], hw_at_alphas_resolution(views.pair(name)))
        if image is not views.images[name]:
            rig = views.rig.resize(name, (image.shape[-2], image.shape[-1]))
            views = views.replace({name: image}, rig=rig)
    return StepResult(views)


def _cropped(network: FusionNetwork, views: Views, name: str) -> Views:
    """Crop a beta to the part that search segments touch, if much smaller; unless a field depends on it.

    It would be enlarged for nothing, and be compared with alpha by the levels of what alpha does not see.
    """
    h, w = views.rig[name].hw
    if resolution_ratio(views.pair(name)) > 0.8:
        return views
    ends = _coarse_ends(views, name)
    top, bottom, left, right = box_around(ends, (h, w), network.beta_halo, network.multiple)
    if (bottom - top) * (right - left) > 0.75 * h * w:
        return views
    rig = views.rig.transformed(name, shift_matrix(left, top), (bottom - top, right - left))
    cropped = views.replace({name: views.images[name][..., top:bottom, left:right]}, rig=rig)
    again = _coarse_ends(cropped, name) + ends.new_tensor([left, top])
    return cropped if ends.shape == again.shape and torch.allclose(ends, again, atol=0.01) else views


def _coarse_ends(views: Views, name: str) -> Float[Tensor, "n 2"]:
    """Return the ends of a beta's search segments, or its sampling positions, of some of alpha's pixels."""
    pair = views.pair(name)
    x = coarse_grid(pair.alpha.hw).reshape(-1, 2)
    return ends_of(lazily(views.fields.get(name) or default_field(pair), pair)(x))


def normalise_betas(views: Views, *, undone: bool = False) -> StepResult:
    """Give each beta alpha's mean and standard deviation: for cameras of other exposures or filters.

    Args:
        undone: True to give bands their own mean and deviation again in the result, which must have those of
            all betas, in order; False to leave it as bright as alpha.

    Returns:
        The views, and the function that undoes the step.
    """
    in_one_exposure = views.replace({n: normalised(views.images[n], views.own) for n in views.betas})
    if not undone:
        return StepResult(in_one_exposure)
    alpha_level, beta_levels = moments(views.own), [moments(views.images[name]) for name in views.betas]
    bands = [len(views.images[name]) for name in views.betas]
    return StepResult(in_one_exposure, lambda frame: with_own_levels(frame, bands, alpha_level, beta_levels))


def with_own_levels(
    frame: Frame, bands: Sequence[int], alpha_level: Moments, beta_levels: Sequence[Moments]
) -> Frame:
    """Return a frame whose bands, so many of each beta, have their beta's level in place of alpha's."""
    parts = zip(frame.image.split(list(bands)), beta_levels, strict=True)
    return frame._replace(image=torch.cat([alpha_level.matched(planes, scale) for planes, scale in parts]))


def join(which: JoinsBands, views: Views) -> StepResult:
    """Join co-located betas (`co_located`) to one of several bands.

    Undone, the frame's bands are in the rig's order, each with its confidence (`by_band`). For "neighbours"
    nothing is joined if a beta has three bands.

    Args:
        which: "neighbours" to join only those that follow each other in the rig, "all", or "no" for none.

    Returns:
        The views, and the function that undoes the step.
    """
    names, bands = views.betas, {name: len(views.images[name]) for name in views.betas}
    groups = co_located(views.rig, names, views.fields, which)
    if len(groups) == len(names) or (which == "neighbours" and 3 in bands.values()):
        return StepResult(views)
    come = [(name, band) for group in groups for name in group for band in range(bands[name])]
    order = [come.index((name, band)) for name in names for band in range(bands[name])]
    joined = {group[0]: torch.cat([views.images[name] for name in group]) for group in groups}

    def back(frame: Frame) -> Frame:
        by_band = frame.confidence.expand(len(order), -1, -1) if frame.by_band is None else frame.by_band
        return frame._replace(image=frame.image[order], by_band=by_band[order].half())

    cameras = {group[0]: tuple(group) for group in groups}
    joined_views = dataclasses.replace(views, images={views.alpha: views.own, **joined}, joined=cameras)
    return StepResult(joined_views, back)


def co_located(rig: Rig, names: Sequence[str], fields: Fields, which: JoinsBands) -> list[list[str]]:
    """Group the calibrated betas with the same K, R, t, lens and size, and the same field object or none.

    Sensors may differ.

    Args:
        which: "neighbours" to group only those that follow each other, "all", or "no" for none.

    Returns:
        Groups of names, in order; a beta without another like it is a group of one.
    """
    groups: list[list[str]] = []
    for name in names:
        for group in [] if which == "no" else groups[-1:] if which == "neighbours" else groups:
            same_field, view = fields.get(group[0]) is fields.get(name), rig[group[0]]
            if same_field and isinstance(view, Camera) and view.replace(sensor=rig[name].sensor) == rig[name]:
                group.append(name)
                break
        else:
            groups.append([name])
    return groups


def without_lenses(rig: Rig, images: Images) -> tuple[Rig, dict[str, Tensor]]:
    """Replace cameras with lenses, and their images, by pinhole views; see `arraygeom.pinhole_view`.

    Cameras without an image, and pinholes with theirs, stay as they are.

    Returns:
        The rig, and the images resampled, at least 0; pixels outside a lens's range repeat the nearest one
        inside.

    Raises:
        ValueError: for an image without a pixel inside its lens's range, or of another size than its camera.
    """
    straight = dict(images)
    for name, image in images.items():
        camera = rig[name]
        if has_lens(camera):
            view = pinhole_view(camera)
            rig = rig.transformed(name, view.K @ torch.linalg.inv(camera.K), view.hw).with_camera(name, view)
            straight[name] = resampled(image, camera, view, extended=True).values[0].clamp(min=0)
    return rig, straight


def has_lens(view: View) -> TypeGuard[LensView]:
    """Return True if a camera's pixels are not those of a pinhole."""
    return isinstance(view, LensView) and view.distortion is not None


def undone(frame: Frame, undo: Sequence[Undo]) -> Frame:
    """Return a frame taken back to the views before the steps."""
    for back in undo:
        frame = back(frame)
    return frame


def _for_pinhole(field: ReceptiveField | None, lens: View, pinhole: View) -> ReceptiveField | None:
    """Return the field for the pinhole view of alpha: displacements are between pixels of that, too."""
    if not (isinstance(field, Moved | Widened) and has_lens(lens)):
        return field
    within = _for_pinhole(field.field, lens, pinhole)
    assert within is not None
    if isinstance(field, Widened):
        return dataclasses.replace(field, field=within)
    assert isinstance(pinhole, LensView)
    field.require(lens.hw)
    x, defined = pixels_between(lens, pinhole)
    rays, valid = lens.to(torch.float64).rays(field.points(x))
    there = map_homogeneous(pinhole.K.double()[:2], rays[..., :2] / rays[..., 2:])
    usable = defined & valid & (rays[..., 2] > 0)
    step = torch.where(usable[..., None], there - pixel_grid(pinhole.hw, dtype=torch.float64), 0.0)
    return Moved(within, step.movedim(-1, 0).to(field.displacement))


def _distorted(frame: Frame, straight: Tensor, original: Tensor, pinhole: View, lens: View) -> Frame:
    """Return the frame at the pixels of alpha's own image."""
    if not has_lens(lens):
        return frame
    assert isinstance(pinhole, LensView)
    shown = torch.cat([frame.image - straight, frame.confidence[None]])
    inverse = torch.stack([(1 / frame.depth).nan_to_num(0.0), frame.half_width.nan_to_num(0.0)])
    back = resampled(shown, pinhole, lens, interpolation="bilinear").values[0]
    del shown
    inverse_depth, half_width = resampled(inverse, pinhole, lens, interpolation="nearest").values[0]
    has_depth = inverse_depth != 0
    depth = torch.where(has_depth, 1 / torch.where(has_depth, inverse_depth, 1.0), torch.nan)
    half_width = torch.where(has_depth, half_width, torch.nan)
    by_band = frame.by_band
    if by_band is not None:
        bands = (resampled(b[None].float(), pinhole, lens, interpolation="bilinear") for b in by_band)
        by_band = torch.stack([band.values[0, 0].to(by_band) for band in bands])
    return Frame(original + back[:-1], depth, back[-1], half_width, by_band)


def of_size(image: Float[Tensor, "c h w"], hw: HW) -> Float[Tensor, "c h2 w2"]:
    """Return an image of this size, by cubic interpolation, clipped to 0..1; itself if it has that size."""
    if image.shape[-2:] == hw:
        return image
    resized = interpolate(image[None], size=hw, mode="bicubic", align_corners=False, antialias=True)
    return resized[0].clamp(0, 1)


def hw_at_alphas_resolution(pair: Pair) -> HW:
    """Return the size of beta's image with pixels of about alpha's size where the views meet.

    Its own size if its pixels are nearly so; else at least 16 a side.
    """
    scale, (h, w) = resolution_ratio(pair), pair.beta.hw
    if 0.8 < scale < 1.25:
        return pair.beta.hw
    return max(round(h / scale), 16), max(round(w / scale), 16)


def resolution_ratio(pair: Pair) -> float:
    """Return pixels of beta per pixel of alpha, by the rough homography at its middle; 1 if undefined."""
    steps = _steps_in_beta(pair)
    area = 0.0 if steps is None else abs(float(torch.linalg.det(steps)))
    return math.sqrt(area) if area > 0 else 1.0


def quarter_turns(pair: Pair) -> int:
    """Return the quarter turns (`Camera.rot90`), 0 to 3, that make beta upright as alpha; 0 if undefined."""
    steps = _steps_in_beta(pair)
    if steps is None:
        return 0
    (a, c), (b, d) = steps.tolist()
    return round(math.atan2(c - b, a + d) / (math.pi / 2)) % 4


def _steps_in_beta(pair: Pair) -> Float[Tensor, "2 2"] | None:
    """Return steps in beta, by the rough homography, of a pixel right and one down from alpha's middle."""
    h, w = pair.alpha.hw
    middle = torch.tensor([[(w - 1) / 2, (h - 1) / 2]], dtype=torch.float64)
    steps = torch.cat([middle, middle + torch.tensor([[1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)])
    x, valid = rough_transfer(pair, steps)
    return x[1:] - x[:1] if bool(valid.all()) else None
