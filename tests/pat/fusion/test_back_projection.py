"""Colour put right by what betas recorded: what they would have recorded of the image is what they show."""

import pytest
import torch
from torch.nn.functional import avg_pool2d, interpolate

from arraygeom import Segments, pixel_grid
from arraygeom.fields.grid import FieldOnGrid
from pat.fusion.back_projection import _recorded, back_projected, missing
from pat.matching.inputs import Beta, Inputs
from pat.matching.matches import BetaMatches, Matches
from pat.matching.normalisation import Comparison, Normalisation
from pat.matching.spectral_mix import SpectralMix
from pat.media.colour import luminance
from pat.networks.protocol import FusionOutput

H, W = 36, 48
RATES = [2, 3, 4, (2, 3)]


def colours(seed: int = 0) -> torch.Tensor:
    noise = torch.rand(1, 3, H, W, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return 0.5 + (avg_pool2d(noise, 3, 1, 1) - 0.5)


def enlarged_beta(image: torch.Tensor, rate, offset=(0, 0)) -> Beta:
    """A beta at alpha's place, its image reduced by that rate and enlarged again, less an offset."""
    down, across = rate if isinstance(rate, tuple) else (rate, rate)
    recorded = avg_pool2d(image, (down, across))
    again = interpolate(recorded, image.shape[-2:], mode="bicubic", align_corners=False)
    x, y = offset
    return Beta(again[..., y:, x:], in_place(), offset=offset, enlargement=(float(down), float(across)))


def position(offset=(0, 0)) -> torch.Tensor:
    grid = pixel_grid((H, W), dtype=torch.float64).movedim(-1, 0)[None]
    return grid - grid.new_tensor(offset)[:, None, None]


def in_place() -> FieldOnGrid:
    """Segments of a match of no disparity at the same pixel."""
    end = pixel_grid((H, W), dtype=torch.float64)[None]
    return FieldOnGrid(
        lambda x: x, 2, Segments(end - end.new_tensor([8.0, 0.0]), end, torch.ones(1, H, W).bool())
    )


def matched_with(mix: SpectralMix | None, count: int) -> Matches:
    """Of betas at alpha's place, whose bands were combined so."""
    level = Normalisation(torch.zeros(3, 1, 1, 1, 1), ([0.0], [0.0]))
    comparison = Comparison(mix, level, level)
    one = BetaMatches(torch.zeros(1, 1, H, W), torch.zeros(1, 1, H, W), comparison)
    return Matches((one,) * count)


@pytest.mark.parametrize("rate", RATES)
def test_nothing_is_missing_where_beta_recorded_the_image(rate):
    truth = colours()
    lacks = missing(
        truth, luminance(truth), position(), torch.ones(1, 1, H, W).double(), enlarged_beta(truth, rate)
    )
    assert lacks.abs().max() < 0.01
    wrong = missing(
        colours(1), luminance(truth), position(), torch.ones(1, 1, H, W).double(), enlarged_beta(truth, rate)
    )
    assert wrong.abs().max() > 0.05


@pytest.mark.parametrize("rate", RATES)
def test_detail_that_was_lost_comes_back(rate):
    truth = colours()
    beta = enlarged_beta(truth, rate)
    blurred = avg_pool2d(torch.nn.functional.pad(truth, (3, 3, 3, 3), mode="replicate"), 7, 1)
    lacks = missing(blurred, luminance(truth), position(), torch.ones(1, 1, H, W).double(), beta)
    before, after = (blurred - truth).square().mean(), (blurred + lacks - truth).square().mean()
    assert after < 0.95 * before


def test_noise_of_beta_comes_hardly_where_alpha_is_flat():
    """And as it is where alpha has more detail than that."""
    truth = torch.full((1, 3, H, W), 0.5).double()
    noisy = enlarged_beta(truth + 0.1 * (colours() - 0.5), 2)
    sure = torch.ones(1, 1, H, W).double()
    busy, flat = (
        missing(truth, alpha, position(), sure, noisy).square().mean()
        for alpha in (luminance(10 * (colours(1) - 0.5)), luminance(truth))
    )
    assert flat < 1e-6 * busy
    assert busy > 1e-6


@pytest.mark.parametrize("rate", RATES)
def test_parts_of_a_beta_give_the_same(rate):
    truth, weight = colours(), torch.ones(1, 1, H, W).double()
    image = colours(1)
    of_whole = missing(image, luminance(truth), position(), weight, enlarged_beta(truth, rate))
    of_part = missing(
        image, luminance(truth), position((6, 10)), weight, enlarged_beta(truth, rate, offset=(6, 10))
    )
    inner = (..., slice(10 + 16, None), slice(6 + 16, None))
    assert torch.allclose(of_whole[inner], of_part[inner], atol=1e-5)


def put_right(image, *betas, mix=None, confidence=None, keeps_luminance=True) -> torch.Tensor:
    """The image, put right by betas at alpha's place."""
    count, sure = len(betas), torch.ones(1, H, W).double() if confidence is None else confidence
    output = FusionOutput(image, [position()] * count, [sure] * count, [sure] * count)
    inputs = Inputs(luminance(image), betas)
    return back_projected(output, matched_with(mix, count), inputs, keeps_luminance=keeps_luminance).image


def test_luminance_stays_and_what_is_not_matched():
    truth, image = colours(), colours(1)
    confidence = torch.ones(1, H, W).double()
    confidence[..., 24:] = 0
    better = put_right(image, enlarged_beta(truth, 2), confidence=confidence)
    assert torch.allclose(luminance(better), luminance(image), atol=1e-9)
    assert torch.equal(better[..., 24:], image[..., 24:])
    assert (better - image)[..., :24].abs().max() > 0.01


def test_bands_of_several_betas_are_each_ones_own():
    truth, image = colours(), colours(1)
    apart = put_right(image, *(enlarged_beta(truth[:, i : i + 1], 2) for i in range(3)))
    joined = put_right(image, enlarged_beta(truth, 2))
    assert torch.allclose(apart, joined, atol=1e-9)


def test_of_measured_bands_the_combination_that_alpha_sees_stays():
    truth, image = colours(), colours(1)
    weights = torch.tensor([[0.5, 0.3, 0.2]]).double()
    slopes = torch.tensor([[0.8, 1.2, 1.2]]).double()  # weights @ slopes = 1
    mix = SpectralMix(weights, torch.tensor([0.1]).double(), slopes, torch.tensor([1.0]).double())
    beta = enlarged_beta(truth, 2)
    better = put_right(image, beta, mix=mix, keeps_luminance=False)
    whole = put_right(image, beta, keeps_luminance=False)
    assert torch.allclose(mix.of(better), mix.of(image), atol=1e-6)
    assert (better - image).abs().max() > 0.01
    assert (mix.of(whole) - mix.of(image)).abs().max() > 0.01  # nothing is known to stay


def test_two_betas_of_the_same_colours_count_as_one():
    truth, image = colours(), colours(1)
    beta = enlarged_beta(truth, 2)
    assert torch.allclose(put_right(image, beta, beta), put_right(image, beta))


def test_gradients_are_those_of_differences():
    truth, image = colours()[..., :12, :12], colours(1)[..., :12, :12].requires_grad_(True)
    beta, weight = enlarged_beta(truth, 3), torch.full((1, 1, 12, 12), 0.8).double()
    where = (position()[..., :12, :12] + 0.37).requires_grad_(True)
    alpha = luminance(truth).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda *x: missing(*x, weight, beta), (image, alpha, where))


def test_a_pixel_between_two_of_beta_is_in_both_by_its_area():
    image = torch.tensor([[1.0, 2.0, 3.0, 4.0]]).expand(1, 1, 2, 4)
    corner = torch.stack(torch.meshgrid(torch.arange(4) + 0.5, torch.arange(2.0), indexing="xy"), -1)[None]
    recorded, area = _recorded(image, corner, torch.ones(1, 1, 2, 4), torch.tensor([2.0, 2.0]), (1, 3))
    assert torch.allclose(area, torch.tensor([[[[3.0, 4.0, 1.0]]]]))
    assert torch.allclose(recorded, torch.tensor([[[[4 / 3, 3.0, 4.0]]]]))
