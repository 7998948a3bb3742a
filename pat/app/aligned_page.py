"""Web page of aligned bands: any two under a slider, composites, and what a camera does not see."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from arraygeom import Rig

from ..fusion.align import Aligned
from ..media.figures import colour_depth
from .report import Facts, data_url, filled_page, rig_drawing, shares_layer

STRETCH = (1.0, 99.0)
"""Percentiles of a band's values that are shown black and white."""
COLOURS = {"colour": (650.0, 550.0, 470.0), "infrared composite": (840.0, 660.0, 550.0)}
"""Wavelengths in nanometres shown as red, green and blue."""
NEAREST = 60.0
"""Largest distance of a band's centre from those wavelengths, nanometres."""
RED, NEAR_INFRARED = 660.0, 840.0


def aligned_page(aligned: Aligned, rig: Rig, facts: Facts) -> str:
    """Compose the page of an aligned frame, with everything in one HTML file.

    Args:
        rig: rig of the recorded files, with all of these cameras.
        facts: notes and warnings; the rest is not used.

    Returns:
        The HTML.
    """
    h, w = aligned.depth.shape
    figures = {"size": f"{w} x {h} pixels", "bands": ", ".join(aligned.bands)}
    visible = {name: view.valid for name, view in aligned.items() if name != aligned.alpha}
    return filled_page(
        f"{', '.join(aligned)} at the pixels of {aligned.alpha}",
        (h, w),
        {name: data_url(image) for name, image in shown_layers(aligned, rig).items()},
        {f"not seen by {name}": shares_layer(torch.from_numpy(v).float()) for name, v in visible.items()},
        figures | {f"seen by {name}": f"{valid.mean():.1%}" for name, valid in visible.items()},
        facts,
        RIG=rig_drawing(rig, aligned.alpha),
    )


def shown_layers(aligned: Aligned, rig: Rig | None = None) -> dict[str, Float[Tensor, "_ h w"]]:
    """Make the layers of the page: each camera's bands, composites, NDVI (see `ndvi`) and depth.

    Bands are stretched to 0..1. Composites and NDVI need bands of suitable wavelengths.

    Args:
        rig: rig of the recorded files, with all of these cameras, for NDVI, as for `ndvi`.

    Returns:
        Images (1 or 3, h, w), 0..1, by name: a camera's for its one or three bands, else for its first one,
        and a band's own for the others; then "colour", "infrared composite", "NDVI" and "depth", where there
        are such bands and known depths. One that has a camera's or band's name, such as "colour", is called
        "derived colour".
    """
    layers, derived = {}, {}
    for name, view in aligned.items():
        bands = [_stretched(band, view.valid) for band in view.values]
        layers[name] = torch.stack(bands if len(bands) in (1, 3) else bands[:1])
        if len(bands) not in (1, 3):
            layers |= {band: plane[None] for band, plane in zip(view.bands[1:], bands[1:])}
    for name, waves in COLOURS.items():
        chosen = [_band_near(aligned, wave) for wave in waves]
        if all(chosen) and len({band.name for band in chosen if band}) == len(waves):
            derived[name] = torch.stack([_stretched(band.values, band.valid) for band in chosen if band])
    if (index := ndvi(aligned, rig)) is not None:
        derived["NDVI"] = _index_colours(index)
    if np.isfinite(aligned.depth).any():
        derived["depth"] = colour_depth(torch.from_numpy(aligned.depth))
    return layers | {f"derived {n}" if n in layers else n: layer for n, layer in derived.items()}


def ndvi(aligned: Aligned, rig: Rig | None = None) -> NDArray[np.float32] | None:
    """Compute (near infrared - red) / (near infrared + red) of light (of reflectance: Tucker's index, 1979).

    Args:
        aligned: values of the cameras at alpha's pixels, in one unit.
        rig: rig of the recorded files, whose sensors' black level, exposure and gain (if one number) are
            removed from values, which are counts; None to take values as light.

    Returns:
        The index (h, w), float32, -1..1 unless values are negative; NaN where one of the cameras does not see
        the point, or the sum is not above 0. None unless the bands nearest to 840 and 660 nm are within
        `NEAREST` of these and of different names.

    Raises:
        ValueError: for a rig without the camera of either band.
    """
    nir, red = (_band_near(aligned, wave) for wave in (NEAR_INFRARED, RED))
    if nir is None or red is None or nir.name == red.name:
        return None
    infrared, visible = (_light(band, rig) for band in (nir, red))
    total = infrared + visible
    with np.errstate(all="ignore"):
        index = (infrared - visible) / total
    return np.where(nir.valid & red.valid & (total > 0), index, np.float32(np.nan))


def _light(band: _ShownBand, rig: Rig | None) -> NDArray[np.float32]:
    values = band.values.astype(np.float32)
    if rig is None:
        return values
    sensor = rig[band.camera].sensor
    gain = sensor.gain if isinstance(sensor.gain, float | int) else 1.0
    return np.maximum(values - sensor.black_level, 0) / np.float32((sensor.exposure or 1.0) * gain)


class _ShownBand(NamedTuple):
    """Band of an alignment, with a mask of the points that its camera sees."""

    camera: str
    name: str
    values: NDArray[Any]
    valid: NDArray[np.bool_]


def _band_near(aligned: Aligned, wave: float) -> _ShownBand | None:
    """Band whose centre is nearest to a wavelength; None if none is within `NEAREST`."""
    near = {
        abs(centre - wave): _ShownBand(camera, name, values, view.valid)
        for camera, view in aligned.items()
        for name, centre, values in zip(view.bands, view.wavelengths, view.values)
        if centre is not None and abs(centre - wave) <= NEAREST
    }
    return near[min(near)] if near else None


def _stretched(values: NDArray[Any], valid: NDArray[np.bool_]) -> Float[Tensor, "h w"]:
    light = values.astype(np.float32)
    counts = valid & np.isfinite(light)
    if not counts.any():
        return torch.zeros(values.shape)
    low, high = np.percentile(light[counts], STRETCH)
    shown = np.nan_to_num((light - low) / max(high - low, 1e-9)).clip(0, 1)
    return torch.from_numpy(shown.astype(np.float32))


def _index_colours(index: NDArray[np.float32]) -> Float[Tensor, "3 h w"]:
    """Colours of an index: -1 brown, 0 pale, 1 green; black where unknown."""
    stops = torch.tensor([[0.55, 0.32, 0.04], [0.96, 0.96, 0.86], [0.0, 0.41, 0.22]])
    value = torch.from_numpy(np.nan_to_num(index)).clamp(-1, 1)[..., None]
    brown, green = torch.lerp(stops[1], stops[0], -value), torch.lerp(stops[1], stops[2], value)
    colour = torch.where(value < 0, brown, green)
    finite = torch.from_numpy(np.isfinite(index))[..., None]
    return torch.where(finite, colour, 0.0).movedim(-1, 0)
