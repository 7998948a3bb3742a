"""What the explorer shows: one alpha pixel and a state of the controls in, everything that is drawn out.

Only the one pixel is worked out, so that an answer takes milliseconds whatever the images' size. No widget is
known here. The weights are those of C3 attention with the plainest features there are: luminance in a window
around each point, its mean taken away and brought to length one, so that scores are normalised correlations. Windows
of beta are mapped by the rough homography, so that other focal lengths and rotated cameras compare the same patch.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from arraygeom import (
    Camera,
    Curved,
    Epipolar,
    HomographyDisplacement,
    Pair,
    Positions,
    ReceptiveField,
    Rectified,
    Rig,
    Segments,
    Widened,
    apply_homography,
    depth_of,
    pixel_grid,
    sample,
)
from arraygeom.fields import FIELDS, covering_displacement, recorded_field
from arraygeom.fields.default import LINE_SHARE
from arraygeom.pixels import HW

from ..media.colour import luminance


@dataclass(frozen=True)
class State:
    """Where the controls stand.

    `x` is alpha's pixel. `near` and `far` (metres) stand in for the rig's, `displacement` (pixels of beta) for what
    covers the depth range; None leaves them. `across` widens the field (pixels). `changes` are steps of the
    rig's numbers, named and measured as in `Rig.parameters` (radians, metres, pixels). `sharpness` multiplies scores.
    """

    alpha: str
    x: tuple[float, float]
    family: str = "auto"
    near: float | None = None
    far: float | None = None
    displacement: float | None = None
    across: float = 0.0
    sharpness: float = 30.0
    changes: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    def replace(self, **changes: object) -> State:
        """A copy with some controls moved."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]


class SeenInBeta(NamedTuple):
    """Where one beta is looked at for the pixel, and what is found.

    xy: samples in beta's pixels; `counts` says which count. ends: start and end where the field is a segment.
    weight: of each sample, 1 in all. depth: of each sample in metres, NaN where there is none.
    value: beta's image there, weighted. position, spread, peak: as those of `pat.attention`.
    """

    xy: Float[Tensor, "l 2"]
    counts: Bool[Tensor, "l"]
    ends: Float[Tensor, "2 2"] | None
    weight: Float[Tensor, "l"]
    depth: Float[Tensor, "l"]
    value: Float[Tensor, "c"]
    position: Float[Tensor, "2"]
    spread: float
    peak: float


class Seen(NamedTuple):
    """The rig with its changes, what each beta shows or why it shows nothing, and the colour put together."""

    rig: Rig
    betas: dict[str, SeenInBeta]
    problems: dict[str, str]
    colour: Float[Tensor, "c"]
    depth: float


@dataclass(frozen=True)
class Scene:
    """A rig and its images (C, H, W), with the luminance that is compared made once."""

    rig: Rig
    images: Mapping[str, Tensor]
    guides: dict[str, Tensor] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        for name, image in self.images.items():
            hw = self.rig[name].hw
            if tuple(image.shape[1:]) != hw:
                got, wanted = f"{image.shape[2]}x{image.shape[1]}", f"{hw[1]}x{hw[0]}"
                raise ValueError(f"the image of '{name}' is {got}, the rig says {wanted}: give the right image")
            self.guides[name] = (luminance(image) if image.shape[0] == 3 else image.mean(0, keepdim=True))[None]


FAMILIES = ("auto", *FIELDS)
"""Names of the fields to choose from; auto is the pair's own, as fusion takes it."""


def chosen_field(pair: Pair, state: State) -> ReceptiveField:
    """The field of the state's family, through the lenses where it is depth-bounded."""
    if state.family == "auto":
        return with_displacement(recorded_field(pair), state.displacement)
    if state.family == "epipolar":
        return Curved(256) if pair.has_lens else Epipolar()
    pixels, (h, w) = displacement(pair, state), pair.beta.hw
    options: dict[str, dict[str, Any]] = {
        "homography": {"displacement": pixels},
        "rectified": {"max_disparity": pixels, "alpha_is": "either"},
        "nearest": {"window": max(1, round(pixels))},
        "local": {"size": 9},
        "dense": {"stride": max(1, math.ceil(math.sqrt(h * w / DENSE)))},
        "curved": {"samples": 256},
    }
    return FIELDS[state.family](**options.get(state.family, {}))


DENSE = 2048
"""About how many positions of beta the dense field keeps."""


def with_displacement(found: ReceptiveField, pixels: float | None) -> ReceptiveField:
    """The field with the displacement that the control asks for, if it has one."""
    if pixels is not None and isinstance(found, HomographyDisplacement):
        return HomographyDisplacement(pixels)
    if pixels is not None and isinstance(found, Rectified):
        return dataclasses.replace(found, max_disparity=pixels)
    return found


def displacement(pair: Pair, state: State) -> float:
    """The displacement asked for, else what covers the depth range at this pixel, else 6 % of beta's longer side."""
    if state.displacement is not None:
        return state.displacement
    if pair.link is None and pair.calibrated and pair.depth is not None:
        return max(1.0, float(covering_displacement(pair, pixel_of(state))))
    return LINE_SHARE * max(pair.beta.hw)


def changed_rig(rig: Rig, state: State) -> Rig:
    """The rig with the state's numbers. Raises ValueError if near is beyond far."""
    steps = {name: torch.tensor(step, dtype=torch.float64) for name, step in state.changes.items() if any(step)}
    rig = rig.perturbed(steps)
    if state.near is None and state.far is None:
        return rig
    if rig.depth is None and (state.near is None or state.far is None):
        raise ValueError("the rig has no depth range: give near and far, both")
    near, far = rig.depth or (None, None)
    return rig.replace(depth=(near if state.near is None else state.near, far if state.far is None else state.far))


def look_at(scene: Scene, state: State) -> Seen:
    """What every beta that has an image shows for the state's pixel.

    Raises ValueError for a rig that the state makes impossible. What one beta cannot tell stands in `problems`.
    """
    rig = changed_rig(scene.rig, state)
    betas: dict[str, SeenInBeta] = {}
    problems: dict[str, str] = {}
    for name in rig.betas(state.alpha):
        if name not in scene.images:
            problems[name] = "no image given"
            continue
        try:
            betas[name] = look_in_beta(scene, rig.pair(state.alpha, name), name, state)
        except ValueError as error:
            problems[name] = str(error)
    return Seen(rig, betas, problems, fused_colour(scene, betas, state), joint_depth(betas))


def pixel_of(state: State) -> Float[Tensor, "1 2"]:
    """The state's pixel, in float64."""
    return torch.tensor([state.x], dtype=torch.float64)


def look_in_beta(scene: Scene, pair: Pair, name: str, state: State) -> SeenInBeta:
    """The pixel's samples in one beta, their weights and depths. Raises ValueError where the field does not fit."""
    x = pixel_of(state)
    chosen = chosen_field(pair, state)
    found = (Widened(chosen, across=state.across) if state.across else chosen)(pair, x)
    samples = found.positions(samples_along(found)) if isinstance(found, Segments) else found
    xy, counts = samples.xy[0], samples.mask[0]
    scores = correlations(scene.guides[state.alpha], scene.guides[name], pair, x, xy)
    weight = softmax(state.sharpness * scores, counts)
    position = weight @ xy
    value = sampled(scene.images[name][None], xy) @ weight
    return SeenInBeta(
        xy,
        counts,
        ends_of(found),
        weight,
        depths(pair, x, xy, counts),
        value,
        position,
        float((weight @ (xy - position).square().sum(-1)).sqrt()),
        float(weight.max()),
    )


def ends_of(found: Segments | Positions) -> Float[Tensor, "2 2"] | None:
    """Start and end of the first pixel's segment, if it is one."""
    if not isinstance(found, Segments) or not bool(found.valid[0]):
        return None
    return torch.stack([found.start[0], found.end[0]])


def samples_along(found: Segments) -> int:
    """About one sample a pixel of beta."""
    return math.ceil(float(torch.where(found.valid, found.length, 0.0).max())) + 1


RADIUS = 5
"""Windows of 11 x 11 pixels are compared."""


def correlations(
    alpha: Float[Tensor, "1 1 h w"],
    beta: Float[Tensor, "1 1 hb wb"],
    pair: Pair,
    x: Float[Tensor, "1 2"],
    xy: Float[Tensor, "l 2"],
) -> Float[Tensor, "l"]:
    """Normalised correlations (-1 to 1) of alpha's window at x with beta's at each of xy."""
    steps = (pixel_grid((2 * RADIUS + 1, 2 * RADIUS + 1), dtype=x.dtype) - RADIUS).reshape(-1, 2)
    transformed = steps @ jacobian(pair, x).T
    own = window_features(alpha, x, steps)
    return (window_features(beta, xy, transformed) @ own.T)[:, 0]


def jacobian(pair: Pair, x: Float[Tensor, "1 2"]) -> Float[Tensor, "2 2"]:
    """How steps in alpha map to steps in beta by H, at x; the identity where H maps x nowhere."""
    ends = torch.cat([x, x + x.new_tensor([[0.5, 0.0], [0.0, 0.5]]), x - x.new_tensor([[0.5, 0.0], [0.0, 0.5]])])
    transformed, valid = apply_homography(pair.homography.to(x), ends)
    return (transformed[1:3] - transformed[3:5]).T if bool(valid.all()) else torch.eye(2, dtype=x.dtype)


def window_features(
    guide: Float[Tensor, "1 1 h w"], x: Float[Tensor, "l 2"], steps: Float[Tensor, "k 2"]
) -> Float[Tensor, "l k"]:
    """The window's values around each point, mean 0 and length 1; 0 where it is flat."""
    h, w = guide.shape[-2:]
    where = (x[:, None] + steps).clamp(min=0).minimum(x.new_tensor([w - 1, h - 1]))
    values = sampled(guide, where)[0]
    values = values - values.mean(-1, keepdim=True)
    length = values.norm(dim=-1, keepdim=True)
    return torch.where(length > FLAT, values / torch.where(length > FLAT, length, 1.0), 0.0)


FLAT = 1e-4
"""A window with less contrast than this looks like nothing."""


def softmax(scores: Float[Tensor, "l"], counts: Bool[Tensor, "l"]) -> Float[Tensor, "l"]:
    """Over what counts; all zero where nothing does."""
    if not bool(counts.any()):
        return torch.zeros_like(scores)
    return torch.where(counts, scores, -torch.inf).softmax(0)


def depths(
    pair: Pair, x: Float[Tensor, "1 2"], xy: Float[Tensor, "l 2"], counts: Bool[Tensor, "l"]
) -> Float[Tensor, "l"]:
    """The depth in alpha of each sample, NaN where it has none or the pair is not calibrated."""
    if pair.link is not None or not pair.calibrated:
        return torch.full_like(xy[:, 0], torch.nan)
    found = depth_of(pair, x.expand(len(xy), 2), xy)
    return torch.where(found.valid & counts, found.depth, torch.nan)


def joint_depth(betas: Mapping[str, SeenInBeta]) -> float:
    """The inverse of the mean inverse depth by all weights, metres; NaN if no sample has a depth."""
    inverse, total = 0.0, 0.0
    for seen in betas.values():
        known = seen.depth.isfinite()
        inverse += seen.peak * float((seen.weight[known] / seen.depth[known]).sum())
        total += seen.peak * float(seen.weight[known].sum())
    return total / inverse if inverse > 0 else math.nan


def sampled(image: Float[Tensor, "1 c h w"], x: Float[Tensor, "*l 2"]) -> Float[Tensor, "c *l"]:
    """The image's values at positions, in their precision; the image itself is not copied."""
    return sample(image, x[None].to(image)).values[0].to(x)


def fused_colour(scene: Scene, betas: Mapping[str, SeenInBeta], state: State) -> Float[Tensor, "c"]:
    """Alpha's luminance with the colour that the betas in colour show, each weighted by its peak."""
    own = sampled(scene.guides[state.alpha], pixel_of(state))[:, 0]
    coloured = [s for s in betas.values() if len(s.value) == 3 and s.peak > 0]
    if not coloured:
        return own
    weights = sum(s.peak for s in coloured)
    difference = sum((s.peak / weights) * (s.value - grey_of(s.value)) for s in coloured)
    return own + difference


def grey_of(colour: Float[Tensor, "3"]) -> Float[Tensor, "1"]:
    """Luminance of one colour."""
    return luminance(colour[:, None, None]).reshape(1)


def numbers_of(rig: Rig) -> dict[str, int]:
    """The rig's numbers that can be moved, by name, and how many values each has; not the depth range."""
    if not any(isinstance(camera, Camera) for camera in rig.cameras.values()):
        return {}
    return {name: step.numel() for name, step in rig.parameters(free=["*.*"]).items() if not name.startswith("depth.")}


def image_pixel(x: float, y: float, hw: HW) -> tuple[float, float]:
    """The centre of the pixel that a place on the image belongs to."""
    h, w = hw
    return float(min(max(round(x), 0), w - 1)), float(min(max(round(y), 0), h - 1))
