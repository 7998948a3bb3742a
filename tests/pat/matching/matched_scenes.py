"""Scenes whose matches are known."""

import cv2
import torch

from arraygeom import Pair, Rectified, Segments, View, lazily, pixel_grid
from arraygeom.fields.grid import FieldOnGrid
from pat.matching.colour_transfer import transferred
from pat.matching.inputs import Beta, BetaMatches, Inputs, Matches
from pat.matching.match import located_in_one
from pat.matching.semi_global import matched_at_half_size
from pat.matching.subpixel import matched_at_full_size


def blurred(image: torch.Tensor, blur: float) -> torch.Tensor:
    return torch.from_numpy(cv2.GaussianBlur(image[0, 0].numpy(), (0, 0), blur))[None, None]


def beside(
    scene: torch.Tensor, disparity: int, width: int = 192
) -> tuple[torch.Tensor, torch.Tensor, list[Segments]]:
    """Two images of a flat scene (1, 1, H, W), `disparity` pixels apart, and segments of alpha, left."""
    alpha, beta = scene[..., :width], scene[..., disparity : disparity + width]
    view = View(hw=(alpha.shape[-2], width))
    look = lazily(Rectified(64.0), Pair(view, view))
    found = []
    for step in (1, 2):
        x = (pixel_grid((view.hw[0] // step, width // step), dtype=torch.float64) + 0.5) * step - 0.5
        segments = look(x.reshape(-1, 2))
        shape = (1, *x.shape[:-1])
        found.append(
            Segments(
                segments.start.reshape(*shape, 2),
                segments.end.reshape(*shape, 2),
                segments.valid.reshape(shape),
            )
        )
    return alpha, beta, found


def faint(seed: int, *, contrast: float, blur: float) -> torch.Tensor:
    """A scene with little to hold on to, 64 x 256."""
    soft = blurred(torch.rand(1, 1, 64, 256, generator=torch.Generator().manual_seed(seed)), blur)
    return (0.5 + contrast * (soft - soft.mean()) / soft.std()).clamp(0, 1)


def matched(alpha, beta, segments, blocks, comparison):
    """Disparity and facts of one beta of one band."""
    rough, facts = matched_at_half_size(comparison.half_views(alpha, beta), blocks)
    found, unlike = matched_at_full_size(comparison.views(alpha, beta), segments, rough)
    return found, torch.cat([unlike, facts[:, 1:]], 1)


def semi_global_matching(
    alpha: torch.Tensor,
    beta: torch.Tensor,
    segments: Segments,
    blocks: Segments,
    *,
    sees_luma: bool = True,
) -> BetaMatches:
    """Matches of one beta with its colours, as `match` has them without a choice and certainty."""
    field = FieldOnGrid(lambda _: segments, 1, segments, blocks)
    inputs = Inputs(alpha, (Beta(beta, field),), bands=beta.shape[1], sees_luma=sees_luma)
    (found,) = transferred(inputs, Matches((located_in_one(inputs),))).betas
    return found
