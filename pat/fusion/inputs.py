"""Views to a network's inputs: padded images, each field evaluated once for every pixel of alpha."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Literal, NamedTuple

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from arraygeom import Moved, Pair, ReceptiveField, Sensor, Widened, depth_of
from arraygeom.epipolar import Depth, Track
from arraygeom.fields import AroundDepth, AroundMatches, default_field, pinhole_track
from arraygeom.fields.grid import BLOCK, FieldOnGrid
from arraygeom.fields.ray_depth import ray_depth
from arraygeom.pixels import HW
from arraygeom.runtime.text import length_unit

from ..matching.inputs import Beta, Inputs, combined_bands
from ..matching.semi_global import along_tangents
from ..networks.protocol import FusionNetwork
from .steps import FusionStep, Undo, takes_pinhole_views
from .views import Views, check_precision, innermost, states_distance

LOG = logging.getLogger(__name__)
CLIPPED = 0.995
"""Share of the largest value from which a pixel counts as clipped: rounding, and interpolation."""


class Placement(NamedTuple):
    """Relation of a beta to alpha, by which positions in beta give depth.

    Attributes:
        pair: alpha and the beta.
        points: function from alpha's pixels (n, 2) to their positions in alpha at the time when beta records;
            the pixels themselves unless the field is `Moved`.
        bounds: quantity that the depth range bounds: "depth" along alpha's axis or "distance" along the ray.
    """

    pair: Pair
    points: Callable[[Tensor], Tensor]
    bounds: Literal["depth", "distance"] = "depth"

    @property
    def has_track(self) -> bool:
        """True if positions in beta give depth by a straight track that is the search segment's line."""
        return self.pair.calibrated and self.pair.link is None and not self.pair.has_lens

    def track(self, x: Float[Tensor, "*n 2"]) -> Track:
        """Return the tracks in beta of alpha's pixels, of pinholes.

        Raises:
            ValueError: unless both cameras are calibrated and without lenses.
        """
        return pinhole_track(self.pair, self.points(x))

    def depth(
        self, x: Float[Tensor, "n 2"], x_beta: Float[Tensor, "n 2"], deviation: Float[Tensor, " n"]
    ) -> Depth:
        """Compute the depth of matches, or the distance along alpha's rays if `bounds` says so.

        With lenses and no link it lies within the pair's depth range, if there is one.

        Args:
            x: pixels of alpha.
            x_beta: positions in beta, pixels.
            deviation: standard deviation of `x_beta` along the segment, pixels.

        Returns:
            Depth in the rig's unit, 0 where not valid, with its standard deviation and validity.

        Raises:
            ValueError: for a pair that is not calibrated; without a depth range, for distances and cameras
                that have no pinhole view; and as `depth_of`.
        """
        pair, x = self.pair, self.points(x)
        on_curve = partial(ray_depth, pair, bounds=self.bounds)
        if not (pair.alpha.has_pinhole_view and pair.beta.has_pinhole_view and self.bounds == "depth"):
            return on_curve(x, x_beta, deviation=deviation)
        triangulated = depth_of(pair, x, x_beta, deviation)
        if pair.depth is None or pair.link is not None or not pair.has_lens:
            return triangulated
        near, far = (bound.to(triangulated.depth) for bound in pair.depth)
        beyond = ~(triangulated.valid & (triangulated.depth >= near) & (triangulated.depth <= far))
        there = on_curve(x[beyond], x_beta[beyond], deviation=deviation[beyond])
        return Depth(*(t.masked_scatter(beyond, values) for t, values in zip(triangulated, there)))


class FrameInputs(NamedTuple):
    """A network's inputs for a frame.

    Attributes:
        inputs: images and fields, padded to whole multiples.
        placements: relation of each beta to alpha, in the order of `inputs.betas`.
        hw: alpha's size without padding.
    """

    inputs: Inputs
    placements: list[Placement]
    hw: HW


def prepared(
    network: FusionNetwork, views: Views, steps: Sequence[FusionStep]
) -> tuple[FrameInputs, list[Undo]]:
    """Apply steps to views, and make the network's inputs of them.

    Returns:
        The inputs, and the functions that take a frame back to the views, last step first.

    Raises:
        ValueError: as `check_precision`, `frame_inputs` and the steps.
        TypeError: as `frame_inputs`.
    """
    check_precision(views, network)
    LOG.info("preparing %d images", len(views.images))
    undo: list[Undo] = []
    for step in steps:
        views, back = step(views)
        undo.insert(0, back)
    return frame_inputs(network, views), undo


def frame_inputs(network: FusionNetwork, views: Views) -> FrameInputs:
    """Make the inputs of a network from views that are prepared for it.

    Returns:
        The inputs, with alpha's size without padding.

    Raises:
        ValueError: if alpha's pixels have no valid search segment in a beta (views that do not overlap), as
            `default_field`, for an invalid result of a field, or whatever a field raises for its pair.
        TypeError: for an object that is no field, or gives segments for some pixels and positions for others.
    """
    m, hw = network.multiple, views.rig[views.alpha].hw
    alpha, *images = (padded(views.images[name][None], m) for name in (views.alpha, *views.betas))
    betas, placements = [], []
    for name, image in zip(views.betas, images):
        pair = views.pair(name)
        field = views.fields.get(name) or default_field(pair)
        on_grid = FieldOnGrid.from_field(
            field, pair, hw=(alpha.shape[-2], alpha.shape[-1]), blocks=m % BLOCK == 0
        )
        if network.uses_matches and on_grid.pixels is None:
            on_grid = along_tangents(alpha, combined_bands(image), on_grid, name)
        place = Placement(pair, points_of(field), bounds_of(field))
        around = isinstance(innermost(field), AroundDepth | AroundMatches)
        beta = Beta(
            image,
            on_grid,
            track=place.track if place.has_track else None,
            around=around,
            cameras=views.joined.get(name, (name,)),
            clipped=clipped_in(image, views.rig[name].sensor),
        )
        betas.append(beta)
        if not on_grid.any_valid(pair.alpha.hw):
            unit = length_unit(views.rig)
            bounds = "" if pair.depth is None else f" between {pair.depth[0]:g} and {pair.depth[1]:g} {unit}"
            own = views.fields.get(name) is not None
            suspects = (
                "poses, the depth range and the field's positions" if own else "poses and the depth range"
            )
            raise ValueError(f"alpha's and '{name}'s views do not overlap{bounds}: check the {suspects}")
        placements.append(place)
    inputs = Inputs(alpha, tuple(betas), m, network.beta_halo, bands=network.bands, learned=network.learned)
    return FrameInputs(inputs, placements, hw)


def clipped_in(image: Float[Tensor, "1 c h w"], sensor: Sensor) -> Bool[Tensor, "1 c h w"] | None:
    """Compute the mask of clipped bands: True at the largest value and beside such a pixel.

    The largest value is 1; the image's own if that is more, or if its exposure is stated, which scaled it.
    Values from `CLIPPED` times that count.

    Returns:
        The mask; None if no value counts.
    """
    image = image.detach()
    largest = float(image.max())
    if sensor.exposure is None:
        largest = max(largest, 1.0)
    clipped = image >= CLIPPED * largest
    return max_pool2d(clipped.to(image), 3, 1, 1).bool() if clipped.any() else None


def bytes_beside(inputs: Inputs, images: Iterable[Tensor]) -> float:
    """Return the memory of images whose pixels are not those of the inputs, bytes: the caller's."""
    held = inputs.alpha, *(beta.image for beta in inputs.betas)
    addresses = {image.untyped_storage().data_ptr() for image in held}
    parts = {image.untyped_storage().data_ptr(): image.nbytes for image in images}
    return float(sum(nbytes for place, nbytes in parts.items() if place not in addresses))


def points_of(field: ReceptiveField) -> Callable[[Tensor], Tensor]:
    """Return the function from alpha's pixels to the positions in alpha for which a field searches.

    Returns:
        That of `Moved` fields, also within `Widened`; for other fields the identity.
    """
    if isinstance(field, Widened):
        return points_of(field.field)
    if not isinstance(field, Moved):
        return lambda x: x
    moved, then = field.points, points_of(field.field)
    return lambda x: then(moved(x))


def bounds_of(field: ReceptiveField) -> Literal["depth", "distance"]:
    """Return the quantity that a field's depth range bounds: its attribute `bounds`; without one "depth"."""
    return "distance" if states_distance(innermost(field)) else "depth"


def measured_along(views: Views) -> Literal["depth", "distance"]:
    """Return the kind of a frame's depth: "depth" along alpha's axis or "distance" along its rays."""
    if takes_pinhole_views(views):
        return "depth"
    fields = (views.fields.get(name) or default_field(views.pair(name)) for name in views.betas)
    return "distance" if "distance" in map(bounds_of, fields) else "depth"


def padded(image: Tensor, multiple: int) -> Tensor:
    """Return an image extended at the bottom and the right to whole multiples, by its last row and column."""
    h, w = image.shape[-2:]
    return pad(image, (0, -w % multiple, 0, -h % multiple), mode="replicate")
