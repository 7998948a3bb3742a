"""Bands of one beta: the combination that alpha sees, and the correction of the bands by alpha."""

import numpy as np
import torch
from torch.nn.functional import interpolate

from arraygeom import Pair, Rectified, View
from arraygeom.fields.grid import FieldOnGrid
from pat.matching.band_mix import SpectralMix
from pat.matching.filters import box_mean
from pat.matching.match import coarse_mix

WEIGHTS = torch.tensor([0.3, 0.6, 0.1])


def texture(bands: int, hw: tuple[int, int], seed: int = 0) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    coarse, fine = (
        torch.rand(1, bands, 8, 12, generator=g),
        torch.rand(1, 1, hw[0] // 2, hw[1] // 2, generator=g),
    )
    parts = [interpolate(x, hw, mode="bicubic", align_corners=False) for x in (coarse, fine)]
    return (0.7 * parts[0] + 0.3 * parts[1]).clamp(0, 1)


def seen_in(bands: torch.Tensor) -> torch.Tensor:
    return (WEIGHTS[None, :, None, None] * bands).sum(1, keepdim=True)


def test_the_combination_is_that_of_least_squares_around_each_pixel():
    """NumPy's, of what bands and alpha have beyond their means in squares of 33 pixels."""
    bands = texture(3, (48, 64))
    drift = torch.linspace(0, 0.2, 64).expand(1, 1, 48, 64)
    alpha = (
        seen_in(bands) + 0.05 + 0.01 * torch.randn(1, 1, 48, 64, generator=torch.Generator().manual_seed(1))
    )
    mix = SpectralMix.fitted(bands, alpha + drift, torch.ones_like(alpha))
    local = [(p - box_mean(p, 16)).flatten(2)[0].double().numpy() for p in (bands, alpha + drift)]
    expected = np.linalg.lstsq(local[0].T, local[1][0], rcond=None)[0]
    assert (
        np.abs(mix.weights[0].numpy() / np.sum(mix.weights[0].numpy()) - expected / expected.sum()).max()
        < 0.01
    )
    assert abs(float(mix.weights.sum()) - 1) < 0.03
    assert abs(float((mix.combined(bands) - alpha - drift).mean())) < 1e-3


def test_slopes_are_those_of_detail_whatever_materials_do():
    """Where the second band is bright the first is dark, both have the same pattern; the third has none."""
    g = torch.Generator().manual_seed(0)
    pattern, left = 0.2 * torch.rand(48, 64, generator=g), torch.zeros(48, 64)
    left[:, :32] = 0.5
    bands = torch.stack([pattern + left, 2 * pattern + 0.5 - left, torch.full_like(left, 0.3)])[None]
    mix = SpectralMix.fitted(bands, bands.mean(1, keepdim=True), torch.ones(1, 1, 48, 64))
    assert (mix.slopes[0] - torch.tensor([1.0, 2.0, 0.0])).abs().max() < 0.1


def test_what_is_not_alpha_at_all_does_not_count():
    bands = texture(3, (48, 64))
    alpha = seen_in(bands)
    alpha[..., :8] = 1.0
    mix = SpectralMix.fitted(bands, alpha, torch.ones_like(alpha))
    assert (mix.weights[0] - WEIGHTS).abs().max() < 0.05


def test_alpha_corrects_bands_only_where_these_explain_it():
    bands = texture(3, (48, 64))
    alpha, other = seen_in(bands), texture(1, (48, 64), seed=5)
    known, foreign = (SpectralMix.fitted(bands, a, torch.ones_like(a)) for a in (alpha, other))
    assert float(known.gain) > 0.99
    assert float(foreign.gain) < 0.01
    wrong = bands + 0.05 * torch.randn(bands.shape, generator=torch.Generator().manual_seed(2))
    better = known.reconciled(wrong, alpha)
    assert (known.combined(better) - alpha).abs().max() < 2e-3
    assert (better - bands).square().mean() < (wrong - bands).square().mean()
    assert (foreign.reconciled(wrong, other) - wrong).abs().max() < 2e-3


def test_the_order_of_bands_does_not_matter_to_the_last_bit():
    bands, order = texture(4, (48, 64)), [2, 0, 3, 1]
    alpha = bands[:, :2].mean(1, keepdim=True)
    one, other = (SpectralMix.fitted(b, alpha, torch.ones_like(alpha)) for b in (bands, bands[:, order]))
    assert torch.equal(other.weights, one.weights[:, order])
    assert torch.equal(other.slopes, one.slopes[:, order])
    assert torch.equal(other.combined(bands[:, order]), one.combined(bands))


def test_the_combination_is_found_before_anything_is_matched():
    """Beta sees the same 12 pixels to the left; equal parts would be far from what alpha sees."""
    hw = (96, 160)
    scene = texture(3, (hw[0], hw[1] + 12))
    alpha, beta = seen_in(scene[..., :-12]), scene[..., 12:]
    field = FieldOnGrid.from_field(Rectified(24.0, alpha_is="left"), Pair(View(hw=hw), View(hw=hw)))
    segments, blocks = (field.of_blocks(side) for side in (2, 4))
    mix = coarse_mix(alpha, beta, segments, blocks, 2)
    assert (mix.weights[0] - WEIGHTS).abs().max() < 0.06
    assert float(mix.gain) > 0.9
