"""Scenes whose matches are known."""

import cv2
import torch

from arraygeom import Pair, Rectified, Segments, View, lazily, pixel_grid
from pat.matching.colour_transfer import diffused_from, matched_colours
from pat.matching.matches import BetaMatches
from pat.matching.normalisation import Comparison
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


def matched(alpha, guide, segments, blocks, comparison, half=None):
    """Disparity and facts of one beta whose brightness is `guide`; without `half` both sizes are matched."""
    rough, facts = half or matched_at_half_size(comparison.half_views(alpha, guide), blocks)
    found, unlike = matched_at_full_size(comparison.views(alpha, guide), segments, rough)
    return found, torch.cat([unlike, facts[:, 1:]], 1)


def semi_global_matching(
    alpha: torch.Tensor,
    guide: torch.Tensor,
    beta: torch.Tensor,
    segments: Segments,
    blocks: Segments | None,
    comparison: Comparison | None = None,
) -> BetaMatches:
    """Matches of one beta, whose brightness is `guide`, and its colours by them, as `match` has."""
    comparison = comparison or Comparison.of(alpha, guide)
    disparity, facts = matched(alpha, guide, segments, blocks, comparison)
    colours, weight, _ = matched_colours(alpha, guide, beta, segments, disparity, facts, comparison.whole)
    diffused = diffused_from(colours, alpha, weight)
    return BetaMatches(disparity, facts, comparison, colours, diffused)
