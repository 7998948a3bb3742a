"""Errors of cameras and rig, estimated once a frame from a fusion of reduced images.

A pre-pass matches the images at half the size or less, without a network. Where its matches are reliable,
alpha's response is fitted (`pat.matching.band_mix`), and beta's distance across its search segments
(`pat.fusion.epipolar_offset`). Both are corrected before the frame is fused.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from arraygeom import Segments
from arraygeom.fields.grid import FieldOnGrid
from arraygeom.pixels import HW
from arraygeom.sampling import sample

from ..matching.band_mix import Response, ResponseSpec, fit, given_response
from ..matching.inputs import (
    CONSISTENT,
    Beta,
    BetaMatches,
    Inputs,
    combined_bands,
    enlarged,
    reduced,
    track_in,
)
from ..matching.match import located
from ..matching.normalisation import SETTINGS as NORMALISATION
from ..matching.normalisation import Normalisation, moments
from ..media.filters import blurred
from ..networks.protocol import FusionNetwork
from ..support.settings import size, tuned
from .epipolar_offset import SETTINGS as ALIGNMENT
from .epipolar_offset import Misalignment, fit_misalignment, normals
from .frame import Frame
from .inputs import FrameInputs, padded

LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class PrePassSettings:
    """Settings of the pre-pass: reduced images are matched to estimate corrections before a frame is.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    pixels: int = size(400_000, "Alpha's pixels in the pre-pass, at most")
    small: int = size(50_000, "Alpha's pixels below which the pre-pass is at full size")
    margin: float = tuned(
        0.1, "First value tried: by how much a match must be better than others, as of `BetaMatches.facts`"
    )
    passes: int = size(3, "Pre-passes at most: matches are better where what was found is put right")
    matched: float = tuned(
        0.3,
        "Share of alpha's pixels reliably matched, below which only an exposure is fitted, and less of its "
        "variance need be explained: Middlebury's tune half has .55 at least, plain scenes .26 at most",
    )
    settled: float = size(0.25, "Pixels by which the largest displacement changes, up to which passes end")


SETTINGS = PrePassSettings()


@dataclass(frozen=True)
class Corrections:
    """Alpha's response, and the misalignment of each beta.

    Attributes:
        response: response of alpha in terms of beta's bands.
        misalignments: misalignment of each beta by camera, zeros for none; an empty mapping fits any cameras.
    """

    response: Response
    misalignments: Mapping[str, Misalignment] = field(default_factory=dict)

    def applied(self, inputs: Inputs, hw: HW) -> Inputs:
        """Apply the corrections to a frame's inputs.

        Co-located cameras may be one beta in one frame, and several in another.

        Args:
            inputs: inputs of a frame of the same cameras.
            hw: alpha's size without padding.

        Returns:
            The corrected inputs: alpha and RGB betas by the response, which also gives `sees_luma`, segments
            by the misalignments; fields of positions stay.

        Raises:
            ValueError: for misalignments of other cameras than these.
        """
        cameras = [camera for names in inputs.cameras for camera in names]
        if self.misalignments and set(cameras) != set(self.misalignments):
            raise ValueError(
                f"corrections are of {_named(self.misalignments)}, this frame has {_named(cameras)}: "
                "take those of a frame of the same cameras"
            )
        if not self.response.is_rec601:
            of_beta = self.response.of_beta
            even = (replace(b, image=of_beta(b.image)) if _is_rgb(b) else b for b in inputs.betas)
            inputs = replace(inputs, alpha=self.response.of_alpha(inputs.alpha), betas=tuple(even))
        moved = zip(inputs.betas, self.of_betas(inputs))
        betas = tuple(replace(beta, field=move.applied(beta.field, hw)) for beta, move in moved)
        return replace(inputs, betas=betas, sees_luma=self.response.explains)

    def of_betas(self, inputs: Inputs) -> list[Misalignment]:
        """Return the misalignment of each beta, in order."""
        return [self.misalignments.get(names[0], Misalignment()) for names in inputs.cameras]

    def described(self, hw: HW) -> list[str]:
        """Describe the corrections in lines of text, a line each.

        Args:
            hw: alpha's size, in whose pixels displacements are stated.

        Returns:
            The lines; none if nothing is corrected.
        """
        lines = [] if self.response.is_rec601 else [str(self.response)]
        if self.response.exchanged:
            lines.append(
                "beta's red and blue look exchanged: alpha fits them the other way round. Is the file BGR, "
                "or `bayer` another one, such as RGGB for BGGR?"
            )
        for name, move in self.misalignments.items():
            if move != Misalignment():
                off = f"'{name}' is up to {move.largest(hw):.1f} px off its search segments"
                lines.append(f"{off}: put right for this frame; `pat rig refine` does so for the rig")
        return lines

    def undone(self, frame: Frame) -> Frame:
        """Return the fused frame with its bands changed so that they give alpha as the response states."""
        return frame if self.response.is_rec601 else frame._replace(image=self.response.undone(frame.image))


@torch.no_grad()
def find_corrections(
    network: FusionNetwork, frame: FrameInputs, response: ResponseSpec, *, align: bool
) -> Corrections:
    """Estimate alpha's response and the betas' misalignments, by matching reduced images.

    A response is fitted for RGB betas only, misalignments if every beta has a segment for each pixel; nothing
    is estimated for a network without matches.

    Args:
        response: "fit" to estimate it, "rec601", three weights of red, green and blue, or a `Response`.
        align: True to estimate misalignments.

    Returns:
        The corrections; where none is fitted the stated or Rec. 601's response, its `explained` as found.

    Raises:
        ValueError: for a response of another kind, and for stated weights where there is no RGB beta.
    """
    rgb = any(map(_is_rgb, frame.inputs.betas))
    if not isinstance(response, str | Response) and not rgb:
        raise ValueError("a response needs betas in red, green and blue: leave it out for other bands")
    corrections, fits = Corrections(given_response(response)), response == "fit" and rgb
    align = align and all(beta.field.pixels is not None for beta in frame.inputs.betas)
    if not network.uses_matches or not (fits or align):
        return corrections
    small = _reduced_frame(frame._replace(inputs=replace(frame.inputs, learned=False)))
    for i in range(SETTINGS.passes):
        LOG.info("pre-pass %d of at most %d", i + 1, SETTINGS.passes)
        inputs = corrections.applied(small.inputs, small.hw)
        parts = zip(small.inputs.betas, inputs.betas, located(inputs).betas)
        matches = [_of_beta(inputs.alpha, *of_beta, small.hw) for of_beta in parts]
        response_now = corrections.response
        if rgb:
            found = _fitted(small, matches)
            LOG.info("%s; %.0f %% of its variance is explained", found, 100 * found.explained)
            response_now = found if fits else response_now._replace(explained=found.explained)
        steps = [fit_misalignment(*m[2:]) if align else Misalignment() for m in matches]
        moves = zip(inputs.cameras, corrections.of_betas(inputs), steps)
        by_camera = {camera: before + step for names, before, step in moves for camera in names}
        corrections = Corrections(response_now, by_camera)
        if all(step.largest(small.hw) <= SETTINGS.settled for step in steps):
            break
    return corrections


def _named(cameras: Iterable[str]) -> str:
    return ", ".join(f"'{camera}'" for camera in cameras)


def expected_work(frame: FrameInputs, response: ResponseSpec, *, align: bool) -> float:
    """Estimate the work of `find_corrections`, as a share of fusing the frame: mostly two passes."""
    return 2 * min(SETTINGS.pixels / math.prod(frame.hw), 1.0) if align or response == "fit" else 0.0


def _is_rgb(beta: Beta) -> bool:
    return beta.image.shape[1] == 3


def _reduced_frame(frame: FrameInputs) -> FrameInputs:
    """Return the frame at a half, a quarter, ... of its size."""
    pixels, inputs = math.prod(frame.hw), frame.inputs
    factor = 1 if pixels < SETTINGS.small else 2
    while pixels > SETTINGS.pixels * factor**2:
        factor *= 2
    if factor == 1:
        return frame
    hw = (frame.hw[0] // factor, frame.hw[1] // factor)
    alpha = padded(avg_pool2d(inputs.alpha, factor), inputs.multiple)
    offset = (0.5 / factor - 0.5,) * 2

    def whole(x: Tensor) -> Tensor:
        return (x + 0.5) * factor - 0.5

    betas = []
    for beta in inputs.betas:
        image = padded(avg_pool2d(beta.image, factor), inputs.multiple)
        track = beta.track and track_in(beta.track, whole, 1 / factor, offset)
        small = _reduced_field(beta.field, alpha, whole, factor)
        clipped = beta.clipped
        if clipped is not None:
            clipped = padded(max_pool2d(clipped.to(image), factor), inputs.multiple).bool()
        betas.append(Beta(image, small, track=track, cameras=beta.cameras, clipped=clipped))
    return frame._replace(inputs=replace(inputs, alpha=alpha, betas=tuple(betas)), hw=hw)


def _reduced_field(
    field: FieldOnGrid, alpha: Tensor, whole: Callable[[Tensor], Tensor], factor: int
) -> FieldOnGrid:
    def at(x: Tensor) -> Segments:
        locations = field.at(whole(x))
        assert isinstance(locations, Segments)
        return reduced(locations, factor)

    return FieldOnGrid.evaluated(at, (alpha.shape[-2], alpha.shape[-1]), field.samples // factor + 2)


class _Matches(NamedTuple):
    """Values of one beta at its matches: all (h, w) or (c, h, w), at the size of the pre-pass.

    `before` are beta's own bands, blurred, and `clipped` is where one is at its largest value. Then come the
    arguments of `fit_misalignment`; `luma` is that of the corrected beta, as bright and sharp as `alpha`.
    """

    before: Float[Tensor, "c h w"]
    clipped: Bool[Tensor, "h w"]
    alpha: Float[Tensor, "h w"]
    luma: Float[Tensor, "hb wb"]
    position: Float[Tensor, "h w 2"]
    normal: Float[Tensor, "h w 2"]
    weight: Float[Tensor, "h w"]

    @property
    def place(self) -> Float[Tensor, "h w 2"]:
        """Positions of the matches in beta's width and height, from its middle."""
        h, w = self.luma.shape
        return (self.position + 0.5) / self.position.new_tensor([w, h]) - 0.5


def _of_beta(alpha: Tensor, before: Beta, beta: Beta, matches: BetaMatches, hw: HW) -> _Matches:
    """Return a beta's blurred bands at alpha's pixels, alpha, and reliable matches."""
    h, w = hw
    positions, valid = matches.positions(beta.field.straight, (beta.image.shape[-2], beta.image.shape[-1]))
    where = positions[0, :h, :w]
    luma = combined_bands(beta.image)
    clipped = torch.zeros_like(luma)
    if before.clipped is not None:
        clipped = before.clipped.any(1, keepdim=True).to(luma)
    sampled = sample(torch.cat([before.image, luma, clipped], 1), where.reshape(1, -1, 2).to(luma)).values
    values = sampled.reshape(sampled.shape[1], h, w)
    unlike, margin, _ = matches.facts[0]
    reliable = (unlike < CONSISTENT) & (margin > SETTINGS.margin)
    weight = (enlarged(reliable)[:h, :w] & valid[0, :h, :w]).to(alpha)
    whole = Normalisation.from_images(alpha, luma)
    alpha_soft = whole.softened(alpha)[:, :, :h, :w]
    measured, wanted = (moments(image, weight[None, None]) for image in (values[-2:-1][None], alpha_soft))
    bright = measured.matched(luma, wanted, NORMALISATION.largest_gain)
    soft = blurred(values[:-2][:, None], [ALIGNMENT.blur] * (len(values) - 2))[:, 0]
    normal = normals(beta.field.straight)[0, :h, :w]
    return _Matches(soft, values[-1] > 0.5, alpha_soft[0, 0], bright[0, 0], where, normal.to(where), weight)


def _fitted(frame: FrameInputs, matches: list[_Matches]) -> Response:
    """Response by all RGB betas' matches."""
    h, w = frame.hw
    soft = blurred(frame.inputs.alpha[:, :, :h, :w], [ALIGNMENT.blur])[0, 0]
    colour = [(m, (m.weight > 0) & ~m.clipped) for m in matches if len(m.before) == 3]
    points = [of_beta.before[:, counts] for of_beta, counts in colour]
    places = [of_beta.place[counts] for of_beta, counts in colour]
    alphas = torch.cat([soft[counts] for _, counts in colour])
    matched = float(torch.stack([counts for _, counts in colour]).any(0).double().mean())
    enough = min(matched / SETTINGS.matched, 1.0)
    return fit(torch.cat(points, 1), alphas, torch.cat(places), enough=enough)
