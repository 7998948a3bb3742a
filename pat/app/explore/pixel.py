"""Computation of the explorer: from one alpha pixel and a state of the controls to all that is drawn.

Only one pixel is computed, so that an answer takes milliseconds for any image size; no widget is used here.
The weights are those of C3 attention: of a network, or of the simplest features, luminance in a window around
each point, of mean zero and length one, so that scores are normalised correlations. Windows of beta are
warped by the rough homography, so that cameras of other focal lengths and orientations compare the same
patch.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from arraygeom import (
    Curved,
    Dense,
    HomographyDisplacement,
    Local,
    NearestVoxels,
    Pair,
    Positions,
    ReceptiveField,
    Rectified,
    Rig,
    Segments,
    depth_of,
    pixel_grid,
    sample,
)
from arraygeom.fields import covering_displacement
from arraygeom.fields.default import FIELDS, LINE_SHARE, named_field, recorded_field
from arraygeom.fields.protocol import sampling_locations
from arraygeom.fields.ray_depth import ray_depth, rough_transfer
from arraygeom.fields.widened import direction
from arraygeom.pixels import HW
from arraygeom.uncertainty import Covariance, bands

from ...fusion.steps import hw_at_alphas_resolution, of_size
from ...fusion.views import checked_image
from ...media.colour import luminance
from ...networks.paper import PAT, QueryAndKey
from ...networks.weights import load_weights

WINDOWS = "windows"
"""Name of the weights by correlation of windows."""


@dataclass(frozen=True)
class ExplorerState:
    """State of the explorer, from its controls.

    Attributes:
        alpha: name of alpha.
        x: pixel (x, y) of alpha.
        family: name of the receptive field, one of `FAMILIES` or the scene's, or MODULE:OBJECT.
        near: near bound, in the rig's unit; None for the rig's.
        far: far bound, in the rig's unit; None for the rig's.
        weights: `WINDOWS`, or the name of a network.
    """

    alpha: str
    x: tuple[float, float]
    family: str = "auto"
    near: float | None = None
    far: float | None = None
    weights: str = WINDOWS

    def replace(self, **changes: object) -> ExplorerState:
        """Return a copy with some values changed."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]


class BetaReport(NamedTuple):
    """Samples of alpha's pixel in one beta, with their weights and the match.

    Attributes:
        xy: samples, pixels of beta.
        valid: True for samples in the image.
        ends: start and end of a segment, pixels of beta; None for other fields, or if it is not valid.
        weight: weight of each sample, summing to 1 over valid ones (if any); 0 for others.
        depth: depth of each sample along alpha's axis, in the rig's unit; NaN where it has none.
        offset: distance of the images' own match from the line, pixels; None without one (`match_offset`).
        band: corners of the band that holds the match by the calibration's uncertainty, pixels of beta; None
            without one (`band_corners`).
    """

    xy: Float[Tensor, "l 2"]
    valid: Bool[Tensor, " l"]
    ends: Float[Tensor, "2 2"] | None
    weight: Float[Tensor, " l"]
    depth: Float[Tensor, " l"]
    offset: float | None = None
    band: Float[Tensor, "4 2"] | None = None


class PixelReport(NamedTuple):
    """Reports of one pixel of alpha in all betas.

    Attributes:
        x: the pixel (x, y), float64.
        betas: report by beta.
        problems: reason, in a sentence, by beta that has no report.
        depth: depth along alpha's axis by all betas (`joint_depth`), in the rig's unit; NaN if unknown.
    """

    x: Float[Tensor, "2"]
    betas: dict[str, BetaReport]
    problems: dict[str, str]
    depth: float


@dataclass(frozen=True)
class ExplorerScene:
    """Rig and images of the explorer; the scene itself fills the last three, which are caches.

    Attributes:
        rig: the rig.
        images: images (c, h, w), values 0..1, by camera.
        fields: further fields by name.
        networks: further networks by name.
        covariance: covariance of the rig's parameters, which gives segments their bands; None for none.
        maps: the last map of the whole image, by the controls that gave it.
        guides: luminances (1, 1, h, w) that windows are cut from, by camera.
        features: computed features of networks.

    Raises:
        ValueError: for an image that does not suit its camera, and one of an unknown camera.
        TypeError: for an image that is no tensor.
    """

    rig: Rig
    images: Mapping[str, Tensor]
    fields: Mapping[str, ReceptiveField] = field(default_factory=dict)
    networks: Mapping[str, PAT] = field(default_factory=dict)
    covariance: Covariance | None = None
    maps: dict[str, Any] = field(default_factory=dict)
    guides: dict[str, Tensor] = field(default_factory=dict)
    features: dict[tuple[str, str, str | None], tuple[HW, QueryAndKey]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in [name for name in self.images if name not in self.guides]:
            image = checked_image(self.rig, self.images, name)
            grey = luminance(image) if image.shape[0] == 3 else image.mean(0, keepdim=True)
            self.guides[name] = grey[None]

    def with_rig(self, rig: Rig) -> ExplorerScene:
        """Return the scene with another rig."""
        return dataclasses.replace(self, rig=rig)

    def query(self, network: str, alpha: str) -> Tensor:
        """Return a network's query features of alpha (1, d, h, w).

        Raises:
            ValueError: for weights that are not of the paper's network.
        """
        return self._features((network, alpha, None), self.images[alpha], self.rig[alpha].hw).query

    def key(self, network: str, alpha: str, beta: str, pair: Pair) -> Tensor:
        """Return a network's key features of a beta (1, d, h, w), at alpha's resolution if the network needs
        that.

        Raises:
            ValueError: for weights that are not of the paper's network.
        """
        hw = hw_at_alphas_resolution(pair) if self._network(network).equal_resolution else pair.beta.hw
        return self._features((network, alpha, beta), self.images[beta], hw).key

    def _network(self, name: str) -> PAT:
        return self.networks[name] if name in self.networks else shipped_attention(name)

    def _features(self, which: tuple[str, str, str | None], image: Tensor, hw: HW) -> QueryAndKey:
        """Features of an image of alpha or a beta at a size; computed again when another size is needed."""
        if which not in self.features or self.features[which][0] != hw:
            network, alpha, beta = which
            asked = self._network(network)
            betas = [name for name in self.rig.betas(alpha) if name in self.images]
            number = min(betas.index(beta), asked.betas - 1) if beta else 0
            with torch.no_grad():
                self.features[which] = hw, asked.query_and_key(of_size(image, hw)[None], number)
        return self.features[which][1]


@cache
def shipped_attention(name: str) -> PAT:
    """Load weights of the paper's network, shipped or a file; the network is cached, not to be changed.

    Raises:
        ValueError: for weights of another network, and as `load_weights`.
        FileNotFoundError: for unknown weights.
    """
    network = load_weights(name)
    if not isinstance(network, PAT):
        raise ValueError(f"weights '{name}' are not of the paper's network: its attention alone can be shown")
    return network


DENSE = 2048
"""Approximate number of positions of the dense field."""
SIZED: dict[str, Callable[[Pair, Tensor], ReceptiveField]] = {
    "homography": lambda pair, x: HomographyDisplacement(displacement(pair, x)),
    "rectified": lambda pair, x: Rectified(displacement(pair, x), alpha_is="either"),
    "nearest": lambda pair, x: NearestVoxels(window=max(1, round(displacement(pair, x)))),
    "local": lambda pair, x: Local(9),
    "dense": lambda pair, x: Dense(stride=max(1, math.ceil(math.sqrt(math.prod(pair.beta.hw) / DENSE)))),
    "curved": lambda pair, x: Curved(256),
}
"""Families whose extent follows from the depth range at a pixel, or from the images' size."""
FAMILIES = ("auto", *FIELDS)
"""Names of the fields: `auto` is the default of `pat fuse`. A state takes MODULE:OBJECT, too."""


def located(scene: ExplorerScene, pair: Pair, family: str, x: Float[Tensor, "n 2"]) -> Segments | Positions:
    """Evaluate the field of a family, the scene's own or by name, at pixels of alpha.

    Raises:
        ValueError: for an unknown family, and if the field does not suit the pair.
    """
    field = scene.fields.get(family) or (SIZED[family](pair, x) if family in SIZED else None)
    field = field or (recorded_field(pair) if family == "auto" else named_field(family))
    return sampling_locations(field, pair, x)


def displacement(pair: Pair, x: Float[Tensor, "n 2"]) -> float:
    """Return the displacement from H x that covers the depth range at pixels, or else a share of beta's
    longer side; pixels."""
    if pair.link is None and pair.calibrated and pair.depth is not None:
        return max(1.0, float(covering_displacement(pair, x)))
    return LINE_SHARE * max(pair.beta.hw)


def with_depths(rig: Rig, state: ExplorerState) -> Rig:
    """Return the rig with those depth bounds that the state has, unchanged if it has none.

    Raises:
        ValueError: for only one bound where the rig has none, near beyond far, and bounds not above 0.
    """
    if state.near is None and state.far is None:
        return rig
    if rig.depth is None and (state.near is None or state.far is None):
        raise ValueError("the rig has no depth range: give near and far, both")
    near, far = rig.depth or (None, None)
    near, far = (old if new is None else new for old, new in ((near, state.near), (far, state.far)))
    return rig.replace(depth=(near, far))


def inspect_pixel(scene: ExplorerScene, state: ExplorerState) -> PixelReport:
    """Report on the state's pixel in every beta that has an image.

    Returns:
        The reports; errors that concern one beta, and betas without an image, are in `problems`.

    Raises:
        ValueError: for an alpha that the rig lacks, and impossible depth bounds.
    """
    rig = with_depths(scene.rig, state)
    betas: dict[str, BetaReport] = {}
    problems: dict[str, str] = {}
    for name in rig.betas(state.alpha):
        if name not in scene.images:
            problems[name] = "no image given"
            continue
        try:
            pair = rig.pair(state.alpha, name)
            report = beta_report(scene, pair, name, state)
            guides = scene.guides[state.alpha], scene.guides[name]
            betas[name] = report._replace(
                offset=match_offset(guides, pair, pixel_of(state), (report.xy, report.weight), report.ends),
                band=band_corners(scene, rig, name, state, report.ends),
            )
        except (ValueError, FileNotFoundError) as error:
            problems[name] = str(error)
        except Exception as error:  # of a field of one's own
            problems[name] = f"the field '{state.family}' failed: {type(error).__name__}: {error}"
    x = pixel_of(state)[0]
    return PixelReport(x, betas, problems, joint_depth(betas))


def pixel_of(state: ExplorerState) -> Float[Tensor, "1 2"]:
    """Return the state's pixel, float64."""
    return torch.tensor([state.x], dtype=torch.float64)


def beta_report(scene: ExplorerScene, pair: Pair, name: str, state: ExplorerState) -> BetaReport:
    """Compute a pixel's samples in the beta called `name`, with weights and depths, but no offset and band.

    `pair` is alpha and this beta, with the state's depth bounds; the scene has images of both.

    Raises:
        ValueError: for an unknown field, one that does not suit the pair, and as `shipped_attention`; other
            errors of a field of one's own pass.
        FileNotFoundError: for unknown weights.
    """
    x = pixel_of(state)
    locations = located(scene, pair, state.family, x)
    if isinstance(locations, Segments):  # about one sample a pixel of beta
        longest = float(torch.where(locations.valid, locations.length, 0.0).max())
        samples = locations.positions(math.ceil(longest) + 1)
    else:
        samples = locations
    xy, valid = samples.xy[0], samples.mask[0]
    if state.weights == WINDOWS:
        scores = SHARPNESS * correlations(scene.guides[state.alpha], scene.guides[name], pair, x, xy)
    else:
        query = sampled(scene.query(state.weights, state.alpha), x)
        key = scene.key(state.weights, state.alpha, name, pair)
        larger = xy.new_tensor([key.shape[-1] / pair.beta.hw[1], key.shape[-2] / pair.beta.hw[0]])
        scores = (query.T @ sampled(key, (xy + 0.5) * larger - 0.5))[0]
    weight = softmax(scores, valid)
    depth, ends = depths(pair, x, xy, valid), ends_of(locations)
    return BetaReport(xy, valid, ends, weight, depth)


def band_corners(
    scene: ExplorerScene, rig: Rig, name: str, state: ExplorerState, ends: Float[Tensor, "2 2"] | None
) -> Float[Tensor, "4 2"] | None:
    """Return the corners of the 95 % band around a segment from `ends`, in turn, all in beta's pixels.

    None without a segment or a covariance, and where the point at a depth bound is not in front of beta.

    Raises:
        ValueError: as `bands`.
    """
    if scene.covariance is None or ends is None:
        return None
    band = bands(rig, scene.covariance, state.alpha, name, pixel_of(state))
    along = direction(ends[1] - ends[0])
    left = torch.stack([along[1], -along[0]])
    start, end = ends[0] - band.along[0, 0] * along, ends[1] + band.along[0, 1] * along
    one, two = band.across[0, 0] * left, band.across[0, 1] * left
    corners = torch.stack([start + one, end + two, end - two, start - one])
    return corners if bool(corners.isfinite().all()) else None


ACROSS, STEP = 8, 0.25
"""Distance from the line, and step, for the search of the images' own match, pixels."""
MOST_SAMPLES = 96
"""Samples on the line, around that of the largest weight, from which that search starts."""
CLEAR = 0.8
"""Least correlation of a clear match."""
BETTER = 0.03
"""Gain in correlation that a match beside the line must have over the best one on it."""


def match_offset(
    guides: tuple[Tensor, Tensor],
    pair: Pair,
    x: Float[Tensor, "1 2"],
    samples: tuple[Float[Tensor, "l 2"], Float[Tensor, " l"]],
    ends: Float[Tensor, "2 2"] | None,
) -> float | None:
    """Find how far beside the line the images' own match lies, by correlating windows around both pixels.

    Args:
        guides: luminances of alpha and of beta.
        pair: alpha and beta.
        x: pixel of alpha.
        samples: positions in beta, and their weights.
        ends: start and end of the segment; None for other fields.

    Returns:
        Its distance, pixels; 0 unless it matches better (`BETTER`) than the line near the largest weight.
        None without a segment of some length or valid samples, a clear match, or one within `ACROSS`.
    """
    xy, weight = samples
    if ends is None or not bool((weight > 0).any()) or float((ends[1] - ends[0]).norm()) < 1e-6:
        return None
    along = torch.nn.functional.normalize(ends[1] - ends[0], dim=0)
    across = torch.stack([-along[1], along[0]])
    first = max(int(weight.argmax()) - MOST_SAMPLES // 2, 0)
    line = xy[first : first + MOST_SAMPLES]
    fine = torch.arange(-1, 1 + STEP / 2, STEP).to(xy)[:, None]

    def best(points: Float[Tensor, "*n 2"]) -> tuple[Tensor, float]:
        points = points.reshape(-1, 2)
        scores = correlations(*guides, pair, x, points)
        return points[scores.argmax()], float(scores.max())

    line_score = best(best(line)[0] + fine * along)[1]
    beside = best(line[:, None] + torch.arange(-ACROSS, ACROSS + 1).to(xy)[:, None] * across)[0]
    beside, beside_score = best(beside + fine[:, None] * across + fine * along)
    distance = abs(float((beside - ends[0]) @ across))
    if max(line_score, beside_score) < CLEAR:
        return None
    if beside_score < line_score + BETTER:
        return 0.0
    # at the edge it would be better beyond
    return distance if distance < ACROSS else None


def ends_of(locations: Segments | Positions) -> Float[Tensor, "2 2"] | None:
    """Return start and end of the first pixel's segment; None if it has none."""
    if not isinstance(locations, Segments) or not bool(locations.valid[0]):
        return None
    return torch.stack([locations.start[0], locations.end[0]])


SHARPNESS = 30.0
"""Factor from correlations to scores."""
RADIUS = 5
"""Radius of the windows, pixels: 11 x 11 pixels are compared."""


def correlations(
    alpha: Float[Tensor, "1 1 h w"],
    beta: Float[Tensor, "1 1 hb wb"],
    pair: Pair,
    x: Float[Tensor, "1 2"],
    xy: Float[Tensor, "l 2"],
) -> Float[Tensor, " l"]:
    """Compute the normalised correlations of alpha's window at a pixel with beta's at some positions.

    Args:
        alpha: luminance of alpha.
        beta: luminance of beta.
        pair: alpha and beta, by whose rough transfer windows are scaled and rotated.
        x: pixel of alpha.
        xy: positions in beta, pixels.

    Returns:
        Correlations, -1 to 1; 0 where a window is flat.
    """
    steps = (pixel_grid((2 * RADIUS + 1, 2 * RADIUS + 1), dtype=x.dtype) - RADIUS).reshape(-1, 2)
    transformed = steps @ jacobian(pair, x).T
    return (window_features(beta, xy, transformed) @ window_features(alpha, x, steps).T)[:, 0]


def jacobian(pair: Pair, x: Float[Tensor, "1 2"]) -> Float[Tensor, "2 2"]:
    """Return the Jacobian at x of the rough transfer to beta; the identity where there is none."""
    half = x.new_tensor([[0.5, 0.0], [0.0, 0.5]])
    ends = torch.cat([x, x + half, x - half])
    transformed, valid = rough_transfer(pair, ends)
    return (transformed[1:3] - transformed[3:5]).T if bool(valid.all()) else torch.eye(2, dtype=x.dtype)


def window_features(
    guide: Float[Tensor, "1 1 h w"], x: Float[Tensor, "l 2"], steps: Float[Tensor, "k 2"]
) -> Float[Tensor, "l k"]:
    """Sample the window around each point, normalised to mean 0 and length 1; 0 where it is flat."""
    values = sampled(guide, x[:, None] + steps, extended=True)[0]
    values = values - values.mean(-1, keepdim=True)
    length = values.norm(dim=-1, keepdim=True)
    return torch.where(length > FLAT, values / torch.where(length > FLAT, length, 1.0), 0.0)


FLAT = 1e-4
"""Contrast (length of the centred window) below which a window has no features."""


def softmax(scores: Float[Tensor, " l"], valid: Bool[Tensor, " l"]) -> Float[Tensor, " l"]:
    """Compute the softmax over the valid samples; all zero without any."""
    if not bool(valid.any()):
        return torch.zeros_like(scores)
    return torch.where(valid, scores, -torch.inf).softmax(0)


def depths(
    pair: Pair, x: Float[Tensor, "1 2"], xy: Float[Tensor, "l 2"], valid: Bool[Tensor, " l"]
) -> Float[Tensor, " l"]:
    """Compute the depth in alpha of each sample in beta.

    Args:
        pair: alpha and beta.
        x: pixel of alpha.
        xy: samples, pixels of beta.
        valid: mask of the samples in the image.

    Returns:
        Depths along alpha's axis in the rig's unit; NaN for invalid samples, samples without depth, and pairs
        that are not calibrated or have a link.

    Raises:
        ValueError: for cameras with no pinhole view in a pair without a depth range.
    """
    if pair.link is not None or not pair.calibrated:
        return torch.full_like(xy[:, 0], torch.nan)
    pinholes = pair.alpha.has_pinhole_view and pair.beta.has_pinhole_view
    depth = (depth_of if pinholes else ray_depth)(pair, x.expand(len(xy), 2), xy)
    return torch.where(depth.valid & valid, depth.depth, torch.nan)


def joint_depth(betas: Mapping[str, BetaReport]) -> float:
    """Return the inverse of the weighted mean inverse depth of all betas' samples, in the rig's unit.

    A sample has its own weight, times the largest one of its beta. NaN if no sample has a depth.
    """
    inverse, total = 0.0, 0.0
    for beta in betas.values():
        has_depth = beta.depth.isfinite()
        weight = beta.weight.max() * beta.weight[has_depth]
        inverse += float((weight / beta.depth[has_depth]).sum())
        total += float(weight.sum())
    return total / inverse if inverse > 0 else math.nan


def sampled(
    image: Float[Tensor, "1 c h w"], x: Float[Tensor, "*l 2"], extended: bool = False
) -> Float[Tensor, " c *l"]:
    """Sample an image at positions, in their precision, without copying it."""
    return sample(image, x[None].to(image), extended=extended).values[0].to(x)


def image_pixel(x: float, y: float, hw: HW) -> tuple[float, float]:
    """Return the centre of the pixel nearest to a point, inside the image."""
    h, w = hw
    return float(min(max(round(x), 0), w - 1)), float(min(max(round(y), 0), h - 1))
