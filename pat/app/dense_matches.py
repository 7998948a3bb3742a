"""Depth by dense matches of one beta alone, without a fused image, for refining a rig that is being
estimated."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Rig
from arraygeom.runtime.chunks import whole
from arraygeom.runtime.threads import torch_in_one_thread
from arraygeom.sampling import on_image

from ..fusion.corrections import Corrections
from ..fusion.depth_filling import final_depth
from ..fusion.inputs import prepared
from ..fusion.steps import steps_for, undone
from ..fusion.tiles import fused_in_tiles
from ..fusion.views import Views
from ..matching.band_mix import Response
from ..matching.inputs import Extent, Inputs, Matches, match_positions
from ..matching.match import match
from ..media.images import Images
from ..networks.protocol import FusionOutput, JoinsBands, required
from ..support.blocks import without_autocast

AROUND = [step / 2 for step in range(-6, 7)]
"""Pixels along the segment from a match, one of which must be on beta's image for the match to count."""


class MatchedDepth(NamedTuple):
    """Depth at alpha's pixels by matches.

    Attributes:
        depth: (H, W), along alpha's axis or its rays (`measured_along`), in the rig's unit; NaN if unknown.
        confidence: (H, W): probability that every beta sees the point and its position is right, 0 to 1.
    """

    depth: Float[Tensor, "h w"]
    confidence: Float[Tensor, "h w"]


class MatchesAlone:
    """Network that fuses nothing: its image is alpha, its positions those of matches, confident on beta.

    Args:
        bands: number of beta's bands, with whose luma alpha is compared; None for any combination of bands.
    """

    uses_matches = equal_resolution = learned = True
    keeps_luminance = False
    halo, beta_halo, multiple = 0, 96, 16
    joins_bands: JoinsBands = "no"

    def __init__(self, bands: int | None) -> None:
        self.bands = bands

    def working_bytes(self, alpha: int, betas: Sequence[int]) -> float:
        """Return 0: no memory beside the matches."""
        return 0.0

    def __call__(self, inputs: Inputs, matches: Matches | None = None) -> FusionOutput:
        """Return alpha's image with the matches' positions and confidences.

        Returns:
            Alpha; the chosen positions; deviations of 0; and confidences, 1 where a position near the match
            along its segment (`AROUND`) is on beta's image, else 0.

        Raises:
            ValueError: without matches.
        """
        positions, confidences = [], []
        for beta, matched in zip(inputs.betas, required(matches, inputs).betas):
            hw = beta.image.shape[-2], beta.image.shape[-1]
            segments = beta.field.straight.to(inputs.alpha.device, torch.float64)
            positions.append(matched.positions(segments, hw)[0].movedim(-1, 1))
            middle, towards = (
                match_positions(segments, matched.disparity),
                Extent.from_segments(segments).towards,
            )
            near = (on_image(middle + step * towards, hw) for step in AROUND)
            confidences.append(reduce(torch.logical_or, near).to(inputs.alpha))
        return FusionOutput(inputs.alpha, positions, [0 * c for c in confidences], confidences)


@torch_in_one_thread()
@without_autocast()
@torch.no_grad()
def matched_depth(images: Images, rig: Rig, *, alpha: str, bands: int | None) -> MatchedDepth:
    """Compute depth at alpha's pixels by matches, without a fused image.

    Args:
        bands: number of beta's bands, with whose luma alpha is compared; None to compare the combination of
            bands that is most similar.

    Returns:
        Depth (as of `final_depth`) and confidence at alpha's pixels, detached.

    Raises:
        ValueError: for images that do not fit the rig, views that do not overlap, and a field that raises it.
        TypeError: for images that are no tensors, or no mapping.
    """
    network = MatchesAlone(bands)
    views = Views.of(rig, images, alpha=alpha)
    inputs, undo = prepared(network, views, steps_for(network, normalise=False))
    as_they_are = Corrections(Response.rec601()).applied(inputs.inputs, inputs.hw)
    inputs = inputs._replace(inputs=as_they_are)
    matches = match(as_they_are)
    frame = fused_in_tiles(network, inputs, matches, [whole(inputs.hw)], keep_matched=False).frame
    depth = final_depth(frame, inputs)
    return MatchedDepth(*undone(frame._replace(depth=depth), undo)[1:3])
