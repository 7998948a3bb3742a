"""Mix of bands that alpha sees: a response, stated or fitted, applied and undone; a mix of any bands."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate

from arraygeom import Pair, Rectified, View
from arraygeom.fields.grid import FieldOnGrid
from pat import FuseSettings, fuse
from pat.matching import band_mix
from pat.matching.band_mix import EXPLANATIONS, SETTINGS, Response, SpectralMix, fit, stated_response
from pat.matching.match import coarse_mix
from pat.media.colour import REC601, luminance
from pat.media.filters import box_mean
from pat.networks.weights import load_weights
from pat.support.metrics import score
from tests.pat.layered_array import ALPHA, BETA, load_sample

WEIGHTS = (0.2, 0.4, 0.4)
SPECTRAL_WEIGHTS = torch.tensor([0.3, 0.6, 0.1])


def combined(image, weights=WEIGHTS):
    return (image * torch.as_tensor(weights).to(image)[:, None, None]).sum(-3, keepdim=True)


@pytest.mark.parametrize(
    "response", [Response(torch.tensor(WEIGHTS).double()), stated_response((0.1, 0.5, 0.6))]
)
def test_neutral_stays_neutral_and_luma_becomes_what_alpha_sees(response):
    image = torch.rand(2, 3, 8, 9, dtype=torch.float64)
    applied = response.of_beta(image)
    seen = response.gain * combined(image, response.weights)
    torch.testing.assert_close(luminance(applied), seen)
    torch.testing.assert_close(response.undone(applied), response.gain * image)
    grey = torch.rand(1, 1, 8, 9, dtype=torch.float64).expand(-1, 3, -1, -1)
    torch.testing.assert_close(response.of_beta(grey), response.gain * grey)


@pytest.mark.parametrize("gamma", [0.77, 0.81, 1.0, 1.3])
@pytest.mark.parametrize("weights", [REC601, WEIGHTS, (0.6, 0.3, 0.1)])
def test_a_response_is_recovered_from_colourful_points(weights, gamma):
    g = torch.Generator().manual_seed(0)
    x = torch.rand(3, 4000, generator=g) * 0.9 + 0.05
    alpha = 0.8 * (torch.tensor(weights)[:, None] * x**gamma).sum(0) + 0.01 * torch.randn(4000, generator=g)
    alpha[::20] = torch.rand(200, generator=g)  # wrong matches
    found = fit(x, alpha)
    assert found.gamma == (gamma if gamma == 1 else pytest.approx(gamma, rel=0.035))
    assert found.gain == pytest.approx(0.8, abs=0.03)
    assert (found.weights - torch.tensor(weights)).abs().max() < 0.03
    assert found.is_rec601 is False


def test_where_few_points_match_only_an_exposure_is_fitted():
    g = torch.Generator().manual_seed(0)
    x = torch.rand(3, 4000, generator=g) * 0.8 + 0.1
    where = torch.rand(4000, 2, generator=g) - 0.5
    fall = torch.exp(-1.2 * where.square().sum(1))
    for weights, light in ((WEIGHTS, 0.8), (REC601, 0.8 * fall)):
        alpha = light * (torch.tensor(weights)[:, None] * x).sum(0)
        all_found, exposure = (fit(x, alpha, where, enough=enough) for enough in (1.0, 0.9))
        assert all_found.is_unlike is (weights == WEIGHTS)
        assert bool(all_found.shading) is (weights == REC601)
        assert not exposure.is_unlike
        assert not exposure.shading
        assert exposure.gain < 0.9


def test_grey_points_leave_rec601():
    g = torch.Generator().manual_seed(0)
    grey = torch.rand(4000, generator=g) * 0.9 + 0.05
    x = grey + 0.002 * torch.randn(3, 4000, generator=g)
    assert fit(x, grey + 0.01 * torch.randn(4000, generator=g)).is_rec601


def test_a_sensor_without_filters_is_preferred_to_weights_that_explain_alpha_hardly_better(monkeypatch):
    """Light that differs by place bends the fit; equal weights are taken for it, other sensors are not."""
    g = torch.Generator().manual_seed(0)
    x = torch.rand(3, 1, generator=g) * 0.5 + 0.4 * torch.rand(3, 4000, generator=g) ** 2 + 0.05
    light = 1 + 0.015 * (x[0] - x[0].mean()) / x[0].std()
    noise = 0.01 * torch.randn(4000, generator=g)
    alpha = light * x.mean(0) + noise
    assert fit(x, alpha).weights.tolist() == [1 / 3] * 3
    with monkeypatch.context() as patched:
        others = [one for one in EXPLANATIONS if one[0] == REC601 or one[1][0]]
        patched.setattr(band_mix, "EXPLANATIONS", others)
        assert (fit(x, alpha).weights - 1 / 3).abs().max() > 0.01
    other = fit(x, combined(x[:, :, None], WEIGHTS)[0, :, 0] * light + noise).weights
    assert (other - torch.tensor(WEIGHTS)).abs().max() < 0.06
    gain = fit(x, 0.6 * alpha)
    assert gain.weights.tolist() == [1 / 3] * 3
    assert gain.gain == pytest.approx(0.6, rel=0.02)


def test_the_stated_deviations_are_those_of_the_errors():
    """Twelve materials, each lit a little otherwise in one camera, as much as the prior says."""
    off = []
    for seed in range(12):
        g = torch.Generator().manual_seed(seed)
        material = torch.randint(12, (3000,), generator=g)
        colours = 0.5 + 0.3 * (2 * torch.rand(3, 12, generator=g)[:, material] - 1)
        truth = colours * (0.7 + 0.6 * torch.rand(3000, generator=g))
        light = 1 + SETTINGS.light * torch.randn(12, generator=g)[material]
        alpha = combined(truth[:, :, None], WEIGHTS)[0, :, 0] + 0.005 * torch.randn(3000, generator=g)
        found = fit(light * truth, alpha)
        off.append(
            ((found.weights - torch.tensor(WEIGHTS)) / torch.tensor(found.deviations[:3])).square().mean()
        )
    assert 0.5 < float(torch.stack(off).mean().sqrt()) < 1.7


def test_what_is_not_fitted_has_no_deviation_and_a_fit_says_its():
    g = torch.Generator().manual_seed(0)
    x = torch.rand(3, 4000, generator=g) * 0.8 + 0.1
    assert str(stated_response(WEIGHTS)) == "alpha is 0.20 R + 0.40 G + 0.40 B"
    found = fit(0.5 * x, combined(x[:, :, None], WEIGHTS)[0, :, 0] + 0.01 * torch.randn(4000, generator=g))
    assert all(0 < deviation < 0.02 for deviation in found.deviations[:4])
    assert str(found).endswith(f" (± {found.gain * found.deviations[3]:.2f})")


def points_of_one_hue():
    """Warm surfaces, light and dark, whose hue varies a little."""
    g = torch.Generator().manual_seed(0)
    value = torch.rand(4000, generator=g) * 0.8 + 0.15
    return torch.tensor([0.95, 0.65, 0.3])[:, None] * value * (
        1 + 0.03 * torch.randn(3, 4000, generator=g)
    ), g


def test_in_one_hue_weights_are_preferred_to_a_small_gain_and_a_large_gain_to_weights_of_no_sensor():
    """Both explain alpha there; weights of sum 1 leave beta's exposure, which is true if gains are equal."""
    x, g = points_of_one_hue()
    noise = 0.01 * torch.randn(4000, generator=g)
    for weights in ((0.2, 0.4, 0.4), (0.65, 0.3, 0.05)):
        found = fit(x, (torch.tensor(weights)[:, None] * x).sum(0) + noise)
        assert found.gain == 1
        assert float(found.weights.sum()) == pytest.approx(1)
        as_seen = (torch.tensor(weights).double() - found.weights) @ x.double()
        assert float(as_seen.square().mean().sqrt()) < 0.006
    exposed = fit(0.5 * x, luminance(x[:, None])[0, 0] + noise)
    assert exposed.gain == pytest.approx(2.0, abs=0.03)
    assert exposed.weights.tolist() == list(REC601)


@pytest.mark.parametrize("gain", [0.92, 1.08, 1.2])
def test_in_one_hue_what_no_sensor_does_is_a_gain_and_a_little_of_it_light(gain):
    x, g = points_of_one_hue()
    luma, noise = luminance(x[:, None])[0, 0], 0.01 * torch.randn(4000, generator=g)
    found = fit(x, gain * luma + noise)
    assert found.weights.tolist() == list(REC601)
    assert found.gain == pytest.approx(gain, rel=0.01)
    assert fit(x, (0.8 + 0.2 * gain) * luma + noise).is_rec601


def test_a_gain_is_not_biased_by_the_noise_of_what_it_is_measured_by():
    """Errors that grow with brightness as measured, not as expected, would lower it (Peelle's puzzle)."""
    x, g = points_of_one_hue()
    noise = 0.01 * torch.randn(4000, generator=g)
    assert fit(0.5 * x, luminance(x[:, None])[0, 0] + noise).gain == pytest.approx(2.0, rel=0.01)


@pytest.mark.parametrize("weights", [REC601, (1 / 3, 1 / 3, 1 / 3), (0.2, 0.4, 0.4)])
@pytest.mark.parametrize("vignetted", [False, True])
def test_gain_weights_and_vignetting_are_found_together(weights, vignetted):
    """Two cameras, exposed unlike each other; eight materials, each lit a little otherwise in one of them."""
    g = torch.Generator().manual_seed(0)
    material = torch.randint(8, (4000,), generator=g)
    colours = torch.rand(3, 8, generator=g)[:, material] * 0.6 + 0.2
    truth = colours * (0.7 + 0.6 * torch.rand(4000, generator=g))
    light = 1 + 0.015 * torch.randn(8, generator=g)[material]
    where = torch.rand(4000, 2, generator=g) - 0.5
    fall = torch.exp(-1.2 * where.square().sum(1)) if vignetted else torch.ones(4000)
    alpha = combined(truth[:, :, None], weights)[0, :, 0] + 0.005 * torch.randn(4000, generator=g)
    found = fit(0.7 * fall * light * truth, alpha, where)
    assert found.gain == pytest.approx(1 / 0.7, rel=0.03)
    assert bool(found.shading) is vignetted
    assert (found.weights - torch.tensor(weights).double()).abs().max() < 0.05
    if weights[0] != 0.2:
        assert found.weights.tolist() == list(weights), "one of those that cameras are known to have"


def test_light_that_differs_by_object_is_not_taken_for_other_weights():
    """Four materials, each up to 2 % brighter or darker in the other view, of an alpha exposed otherwise."""
    g = torch.Generator().manual_seed(0)
    colours = torch.tensor([[0.7, 0.6, 0.5], [0.3, 0.45, 0.6], [0.6, 0.3, 0.3], [0.35, 0.5, 0.3]]).T
    material = torch.randint(4, (4000,), generator=g)
    truth = colours[:, material] * (0.7 + 0.6 * torch.rand(4000, generator=g))
    light = torch.tensor([1.02, 0.985, 1.015, 0.98])[material]
    found = fit(0.6 * truth * light, luminance(truth[:, None])[0, 0] + 0.005 * torch.randn(4000, generator=g))
    assert found.weights.tolist() == list(REC601)
    assert found.gain == pytest.approx(1 / 0.6, rel=0.02)


def test_leaves_lit_more_brightly_are_not_taken_for_a_sensor_of_green_alone(monkeypatch):
    """Weights of .7 green would explain them; light that is another in another colour does without."""
    g = torch.Generator().manual_seed(0)
    colours, light = torch.tensor([[0.3, 0.6, 0.2], [0.6, 0.4, 0.25]]).T, torch.tensor([1.08, 1.0])
    material = torch.randint(2, (4000,), generator=g)
    x = (
        colours[:, material]
        * (0.6 + 0.7 * torch.rand(4000, generator=g))
        * (1 + 0.03 * torch.randn(3, 4000, generator=g))
    )
    alpha = luminance(x[:, None])[0, 0] * light[material] + 0.005 * torch.randn(4000, generator=g)
    assert fit(x, alpha).is_rec601
    monkeypatch.setattr(band_mix, "SETTINGS", replace(SETTINGS, light=0.001))
    assert fit(x, alpha).weights[1] > 0.65


def test_a_band_that_no_combination_explains_leaves_rec601(monkeypatch):
    """Near infrared: reflectance is unrelated to the colours, and only shadows are common to all bands."""
    g = torch.Generator().manual_seed(0)
    material = torch.randint(12, (4000,), generator=g)
    shadow = 0.4 + 0.6 * torch.rand(4000, generator=g)
    colours, other = 0.2 + 0.7 * torch.rand(3, 12, generator=g), 0.2 + 0.7 * torch.rand(12, generator=g)
    x, alpha = colours[:, material] * shadow, (colours.mean(0) + other)[material] / 2 * shadow
    assert fit(x, alpha).is_rec601
    assert not fit(x, alpha).explains
    monkeypatch.setattr(band_mix, "SETTINGS", replace(SETTINGS, explained=0.5))
    assert fit(x, alpha).explains


def test_materials_that_near_infrared_shows_otherwise_are_no_wrong_matches():
    """Leaves are a quarter of this scene, which a robust fit leaves out; the rest is as bright as in visible
    light."""
    g = torch.Generator().manual_seed(2)
    material = torch.randint(12, (4000,), generator=g)
    shadow = 0.4 + 0.6 * torch.rand(4000, generator=g)
    colours = 0.1 + 0.5 * torch.rand(3, 12, generator=g)
    x = colours[:, material] * shadow
    leaves = material < 3
    alpha = torch.where(leaves, 0.7 * shadow, luminance(x[:, None])[0, 0])
    assert not fit(x, alpha).explains
    assert fit(x[:, ~leaves], alpha[~leaves]).explains


def test_a_gamma_needs_a_range_of_brightness():
    """Dark surfaces whose light varies: a gamma explains them better, as anything would."""
    g = torch.Generator().manual_seed(1)
    x = torch.tensor([0.2, 0.16, 0.12])[:, None] * (1 + 0.1 * torch.rand(4000, generator=g))
    level = (x[0] - x[0].min()) / (x[0].max() - x[0].min())
    assert (
        fit(
            x, (0.97 + 0.02 * level) * luminance(x[:, None])[0, 0] + 0.0005 * torch.randn(4000, generator=g)
        ).gamma
        == 1
    )


def test_fusion_of_another_response():
    """Taken for Rec. 601, this alpha's colours are several dB off; with its response stated they are not."""
    sample, network = load_sample(), load_weights("mono-colour")
    images = {ALPHA: combined(sample.ground_truth), BETA: sample.images[BETA]}

    def psnr(response, given=images):
        frame = fuse(
            given, sample.rig, alpha=ALPHA, network=network, settings=FuseSettings(response=response)
        )
        return score(frame.image.clamp(0, 1), sample.ground_truth).psnr, frame

    ideal, _ = psnr("rec601", images | {ALPHA: luminance(sample.ground_truth)})
    plain, _ = psnr("rec601")
    stated, frame = psnr(WEIGHTS)
    torch.testing.assert_close(combined(frame.image), images[ALPHA], atol=1e-4, rtol=0)
    assert stated > ideal - 1.2
    assert stated > plain + 2.0


@pytest.mark.parametrize("wrong", [(0.5, 0.5), (0.5, -0.1, 0.6), (0.0, 0.0, 0.0), (float("nan"), 1.0, 1.0)])
def test_wrong_responses_are_refused(wrong):
    with pytest.raises(ValueError, match="weights"):
        stated_response(wrong)


def test_a_share_of_matches_that_is_none_is_refused():
    bands = torch.rand(3, 400)
    assert fit(bands, combined(bands[..., None])[0, :, 0], enough=0).is_rec601
    for enough in (-1.0, 1.5, float("nan")):
        with pytest.raises(ValueError, match="enough"):
            fit(bands, bands[0], enough=enough)


def texture(bands: int, hw: tuple[int, int], seed: int = 0) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    coarse, fine = (
        torch.rand(1, bands, 8, 12, generator=g),
        torch.rand(1, 1, hw[0] // 2, hw[1] // 2, generator=g),
    )
    parts = [interpolate(x, hw, mode="bicubic", align_corners=False) for x in (coarse, fine)]
    return (0.7 * parts[0] + 0.3 * parts[1]).clamp(0, 1)


def seen_in(bands: torch.Tensor) -> torch.Tensor:
    return (SPECTRAL_WEIGHTS[None, :, None, None] * bands).sum(1, keepdim=True)


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
    assert (mix.weights[0] - SPECTRAL_WEIGHTS).abs().max() < 0.05


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
    assert (mix.weights[0] - SPECTRAL_WEIGHTS).abs().max() < 0.06
    assert float(mix.gain) > 0.9
