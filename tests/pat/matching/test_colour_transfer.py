"""Beta's bands at alpha's view: detail, brightness, weight; unseen pixels by diffusion and by example."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from arraygeom import Segments, pixel_grid
from arraygeom.fields.grid import FieldOnGrid
from pat.matching import colour_transfer as warped
from pat.matching import inputs as inputs_module
from pat.matching.colour_transfer import (
    SETTINGS,
    MatchedValues,
    MatchStatistics,
    _diffused,
    by_examples,
    colour_noise,
    directions_of,
    filled_from,
    transferred,
)
from pat.matching.inputs import BetaMatches, Colours, Comparison, Inputs, InputsSettings, Matches
from pat.matching.normalisation import explained_share
from pat.media.colour import luminance
from tests.pat.matching.matched_scenes import beside, blurred, faint, semi_global_matching


def enlarged(image: torch.Tensor, times: int) -> torch.Tensor:
    return image.repeat_interleave(times, -1).repeat_interleave(times, -2)


def in_place(hw: tuple[int, int]) -> list[Segments]:
    """One view for both cameras: each pixel of alpha, and each block of 2x2, is found where it is."""
    places = (pixel_grid((hw[0] // s, hw[1] // s))[None] * s + (s - 1) / 2 for s in (1, 2))
    return [Segments(x, x, torch.ones(x.shape[:-1], dtype=torch.bool)) for x in places]


def chroma_errors(
    alpha: torch.Tensor, beta: torch.Tensor, ground_truth: torch.Tensor, segments: list[Segments]
) -> list[torch.Tensor]:
    """Return the errors of colour differences: at the matches, and of beta's where it is."""
    matched = semi_global_matching(alpha, beta, *segments).carried.bands
    found, given, true = (image - luminance(image) for image in (matched, beta, ground_truth))
    return [found - true, given - true]


def test_what_nothing_sees_varies_with_brightness_as_nearby():
    rng = np.random.default_rng(0)
    brightness = (0.4 + 0.2 * rng.random((24, 32))).astype(np.float32)
    colour = (0.8 * brightness - 0.3)[None]
    weight = np.full(brightness.shape, 1e-4, np.float32)
    weight[:, :16] = 1
    guide = np.full(brightness.shape, 100, np.uint8)
    unseen = np.where(weight < 1, 0, colour).astype(np.float32)
    found = _diffused(unseen, brightness, weight, guide)
    assert np.abs(found - colour)[:, :, 16:].mean() < 0.6 * np.abs(colour - colour.mean()).mean()


def test_a_match_has_the_detail_that_beta_lost():
    """One view for both cameras: a fifth or more of the error of colour that beta's blur made is gone."""
    coarse = torch.rand(1, 1, 12, 16, generator=torch.Generator().manual_seed(2))
    alpha = coarse.repeat_interleave(4, -1).repeat_interleave(4, -2)
    ground_truth = alpha * torch.tensor([1.3, 1.0, 0.4]).view(1, 3, 1, 1) - torch.tensor(
        [0.0, 0.1, 0.2]
    ).view(1, 3, 1, 1)
    beta = torch.cat([blurred(band, 1.0) for band in ground_truth.split(1, 1)], 1)
    here = in_place((48, 64))
    left, lost = (e[..., 6:-6, 6:-6].abs().mean() for e in chroma_errors(alpha, beta, ground_truth, here))
    assert left < 0.8 * lost


def test_of_a_beta_far_less_sharp_more_around_a_pixel_says_what_detail_it_lost(monkeypatch):
    """Within 5 x 5 pixels a beta reduced 8 times shows one value."""
    g = torch.Generator().manual_seed(7)
    alpha = sum(enlarged(torch.rand(1, 1, 96 // s, 128 // s, generator=g), s) for s in (2, 4, 8, 16)) / 4
    ground_truth = alpha * torch.tensor([1.3, 1.0, 0.4]).view(1, 3, 1, 1)
    beta = torch.cat([blurred(band, 4.0) for band in ground_truth.split(1, 1)], 1)

    def left() -> torch.Tensor:
        errors, _ = chroma_errors(alpha, beta, ground_truth, in_place((96, 128)))
        return errors[..., 8:-8, 8:-8].abs().mean()

    wide, detailed = left(), warped._each_detailed
    monkeypatch.setattr(warped, "_each_detailed", lambda *images: detailed(*images[:-1], [2]))
    assert wide < 0.9 * left()


def test_each_of_a_batch_has_the_window_of_its_own_blur():
    g = torch.Generator().manual_seed(8)
    colour, brightness, alpha = (torch.rand(2, c, 24, 32, generator=g) for c in (3, 1, 1))
    both = warped._each_detailed(colour, brightness, alpha, [2, 6])
    for i, radius in enumerate((2, 6)):
        one = (x[i : i + 1] for x in (colour, brightness, alpha))
        assert torch.equal(warped._detailed(*one, radius), both[i : i + 1])
    assert not torch.equal(both, warped._each_detailed(colour, brightness, alpha, [2, 2]))


def test_colour_that_does_not_follow_brightness_is_left_alone():
    """Red and green change places where brightness does not show it, beside edges of brightness."""
    g = torch.Generator().manual_seed(5)
    fine, other = (
        torch.rand(1, 1, 24, 32, generator=g).round().repeat_interleave(4, -1).repeat_interleave(4, -2)
        for _ in "ab"
    )
    alpha = 0.35 + 0.3 * fine
    other = other.roll((2, 2), (-1, -2)) - 0.5
    ground_truth = alpha + 0.25 * other * torch.tensor([1.0, -0.299 / 0.587, 0.0]).view(1, 3, 1, 1)
    beta = torch.cat([blurred(band, 1.0) for band in ground_truth.split(1, 1)], 1)
    here = in_place((96, 128))
    left, lost = (e[..., 6:-6, 6:-6].square().mean() for e in chroma_errors(alpha, beta, ground_truth, here))
    assert left < 1.05 * lost


def test_colour_at_matches_does_not_hang_on_what_the_other_image_shows_elsewhere():
    """Alpha alone sees something dark on the left: whole images differ in level, what both see does not."""
    scene = faint(1, contrast=0.1, blur=3.0)
    scene[..., :48] -= 0.35
    tint = torch.tensor([1.3, 1.0, 0.2]).view(1, 3, 1, 1)
    tint = tint / luminance(tint)
    alpha, beta, segments = beside(scene, 48)
    found = semi_global_matching(alpha, beta * tint, *segments).carried
    assert (found.bands + alpha - alpha * tint)[..., 80:].abs().mean() < 0.009


def certain(
    alpha: torch.Tensor,
    beta: torch.Tensor,
    certainty: float | None,
    seen: slice = slice(None),
    *,
    facts: float = 0.0,
    sees_luma: bool = True,
) -> Colours:
    """Colours of one view for both cameras, in these columns, each match as certain; None: not known."""
    h, w = alpha.shape[-2:]
    segments, blocks = in_place((h, w))
    segments.valid[:] = False
    segments.valid[..., seen] = True
    inputs = Inputs.from_images(alpha, [beta], [FieldOnGrid(lambda _: segments, 1, segments, blocks)])
    inputs, sure = replace(inputs, sees_luma=sees_luma), torch.ones(1, 2, h // 2, w // 2)
    stated = None if certainty is None else certainty * sure
    planes = torch.full((1, 3, h // 2, w // 2), facts)
    matched = BetaMatches(0 * alpha, planes, Comparison.from_images(alpha, beta), certainty=stated)
    (found,) = transferred(inputs, Matches((matched,))).betas
    return found.carried


def with_other_patch() -> tuple[torch.Tensor, torch.Tensor]:
    """Alpha, and a beta that shows something much darker in columns 40 to 59."""
    alpha = faint(1, contrast=0.1, blur=3.0)[..., :128]
    beta = alpha.expand(-1, 3, -1, -1).clone()
    beta[..., 40:60] -= 0.3
    return alpha, beta


def test_of_a_band_that_does_not_explain_alpha_likeness_says_nothing():
    """Near infrared beside a mono camera: certain matches of such a band do not give way to fills."""
    alpha, band = (faint(seed, contrast=0.1, blur=3.0)[..., :128] for seed in (1, 9))
    assert certain(alpha, alpha, 0.9).likeness.min() > 0.9
    assert certain(alpha, band, 0.9).likeness.min() > 0.9
    outside = certain(alpha, band.expand(-1, 3, -1, -1), 0.9)
    assert outside.likeness.median() < 0.6


@pytest.mark.parametrize("certainty", [0.1, 0.5, 0.9])
def test_weight_grows_with_certainty_and_likeness(certainty):
    found = certain(*with_other_patch(), certainty)
    alike, unlike = (found.likeness[..., part] for part in (slice(70, 120), slice(44, 56)))
    assert alike.median() > 0.5
    assert unlike.max() < 0.5 * alike.median()
    right = (torch.tensor(certainty).logit() + SETTINGS.alike * found.likeness).sigmoid()
    torch.testing.assert_close(found.weight, (right * found.likeness).sqrt(), atol=1e-4, rtol=0)
    order = found.likeness.flatten().argsort()
    assert (found.weight.flatten()[order].diff() > -1e-6).all()
    assert (certain(*with_other_patch(), certainty + 0.05).weight >= found.weight).all()


def test_without_certainty_weight_is_the_likeness_halved_where_the_check_fails():
    (sure, halved) = (certain(*with_other_patch(), None, facts=facts) for facts in (0.0, 1.0))
    torch.testing.assert_close(sure.weight, sure.likeness)
    torch.testing.assert_close(halved.weight, halved.likeness / 2)


def test_brightness_says_nothing_of_a_match_if_alpha_sees_something_else():
    found = certain(*with_other_patch(), 0.7, sees_luma=False)
    assert (found.likeness == 1).all()
    right = (torch.tensor(0.7).logit() + SETTINGS.alike).sigmoid().sqrt()
    torch.testing.assert_close(found.weight, right.expand_as(found.weight))


@pytest.mark.parametrize("certainty", [0.0, 1.0])
def test_weight_is_a_share_whatever_the_certainty_and_none_off_beta(certainty):
    weight = certain(*with_other_patch(), certainty, slice(64, None)).weight
    assert (weight[..., :64] == 0).all()
    assert weight.min() >= 0
    assert weight.max() <= 1


def test_statistics_of_pieces_are_those_of_the_whole():
    """No part is brought to alpha's mean and contrast alone."""
    g = torch.Generator().manual_seed(0)
    alpha = torch.rand(1, 1, 40, 60, generator=g) * torch.linspace(0.2, 1, 60)
    beta = 0.5 * alpha + 0.1
    ones = torch.ones_like(alpha)

    def statistics(columns: slice) -> MatchStatistics:
        a, b, one = (image[..., columns] for image in (alpha, beta, ones))
        return MatchStatistics.from_values(a, MatchedValues(b, b, b, a, one > 0, one, None))

    whole = statistics(slice(None))
    pieces = MatchStatistics.mean([statistics(slice(0, 20)), statistics(slice(20, 60))])
    torch.testing.assert_close(whole.leveled(beta), alpha, atol=1e-3, rtol=0)
    torch.testing.assert_close(pieces.leveled(beta), alpha, atol=1e-3, rtol=0)


def test_a_match_of_one_band_has_alphas_detail_even_if_the_band_is_inverted():
    """One view for both: what alpha sees bright the band sees dark, and without alpha it is blurred."""
    g = torch.Generator().manual_seed(2)
    coarse, fine = (torch.rand(1, 1, 96 // s, 128 // s, generator=g) for s in (32, 4))
    alpha = 0.7 * enlarged(coarse, 32) + 0.3 * enlarged(fine, 4)
    ground_truth = 0.8 - 0.6 * alpha
    beta = blurred(ground_truth, 1.5)
    here = in_place((96, 128))
    found = semi_global_matching(alpha, beta, *here).carried.bands + alpha
    left, lost = ((p - ground_truth)[..., 6:-6, 6:-6].abs().mean() for p in (found, beta))
    assert left < 0.7 * lost


def test_colour_is_as_bright_as_alpha_where_betas_lens_is_dark():
    """Beta has half the light on its right: with alpha's light its colours are nearly alpha's."""
    tint = torch.tensor([1.3, 1.0, 0.4]).view(1, 3, 1, 1)
    alpha = faint(2, contrast=0.1, blur=2.0)[..., :128]
    ground_truth = alpha * tint
    beta = ground_truth * torch.linspace(1, 0.5, 128)
    wrong, darker = (
        e[..., 64:].abs().mean() for e in chroma_errors(alpha, beta, ground_truth, in_place((64, 128)))
    )
    assert wrong < 0.6 * darker


@pytest.mark.parametrize(("sees_luma", "kept"), [(True, 0.5**0.6), (False, 1.0)])
def test_colour_is_as_strong_as_beta_shows_it_if_alpha_sees_something_else(sees_luma, kept):
    """Near infrared is half as bright: so are the materials in it, not the light."""
    scene = faint(3, contrast=0.12, blur=1.5)[..., :128]
    beta = scene * torch.tensor([1.3, 1.0, 0.4]).view(1, 3, 1, 1)
    alpha = 0.5 * luminance(beta)
    matched = semi_global_matching(alpha, beta, *in_place((64, 128)), sees_luma=sees_luma)
    found, given = (image - luminance(image) for image in (matched.carried.bands, beta))
    assert float((found * given).sum() / given.square().sum()) == pytest.approx(kept, abs=0.02)


def test_detail_counts_as_far_as_brightness_explains_alpha():
    """None for an alpha of another spectrum, nearly all for a similar one, none for a negative."""
    g = torch.Generator().manual_seed(4)
    alpha, other, noise = (torch.rand(1, 1, 40, 60, generator=g) for _ in range(3))
    ones = torch.ones_like(alpha)
    shares = [float(explained_share(x, alpha, ones)) for x in (0.5 * alpha + 0.05 * noise, other, 1 - alpha)]
    assert shares[0] > 0.98
    assert shares[1] < 0.02
    assert shares[2] == 0


def test_an_alpha_in_the_infrared_gives_no_detail():
    scene = faint(3, contrast=0.12, blur=1.5)[..., :128]
    beta = scene * torch.tensor([1.3, 1.0, 0.4]).view(1, 3, 1, 1)
    infrared = faint(9, contrast=0.12, blur=1.5)[..., :128]
    found = semi_global_matching(infrared, beta, *in_place((64, 128))).carried
    chroma = [image - luminance(image) for image in (found.bands, beta)]
    assert (chroma[0] - chroma[1]).abs().mean() < 0.3 * (
        chroma[1] - chroma[1].mean((2, 3), keepdim=True)
    ).abs().mean()


def noisy_scene(noise: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Alpha, beta and ground truth of stripes of two colours, textured, with noise in both views."""
    g = torch.Generator().manual_seed(6)
    alpha = faint(4, contrast=0.06, blur=2.0)[..., :128]
    tints = torch.tensor([[1.3, 1.0, 0.4], [0.6, 1.1, 1.3]])[torch.arange(128) // 32 % 2].mT[None, :, None]
    truth = alpha * tints
    truth = truth + alpha - luminance(truth)
    return *(p + noise * torch.randn(p.shape, generator=g) for p in (alpha, truth)), truth


def test_noise_of_colour_is_taken_out_and_edges_stay():
    alpha, beta, truth = noisy_scene(0.04)
    found, given = chroma_errors(alpha, beta, truth, in_place((64, 128)))
    assert found.square().mean() < 0.4 * given.square().mean()
    beside_edges = (torch.arange(128) + 1) % 32 < 2
    assert found[..., beside_edges].square().mean() < 1.1 * given[..., beside_edges].square().mean()


def test_texture_and_lost_detail_are_no_noise():
    alpha = noisy_scene(0.0)[0]
    blurry, g = blurred(alpha, 1.0), torch.Generator().manual_seed(7)
    ones = torch.ones_like(alpha)
    assert float(colour_noise(blurry - alpha, alpha, ones)) == 0
    found = [
        float(colour_noise(n * torch.randn(alpha.shape, generator=g), alpha, ones)) for n in (0.02, 0.04)
    ]
    assert found[1] == pytest.approx(4 * found[0], rel=0.3)
    assert colour_noise(alpha, alpha, 0 * ones).tolist() == [[[[0.0]]]]


@pytest.mark.parametrize("tint", [(0.8,), (1.2, 1.0, 0.6)])
def test_pieces_show_no_border_even_far_from_what_beta_sees(tint, monkeypatch):
    """Beta sees none of the lower three quarters, nor anything of one piece, and has corners unlike the rest;
    noise and contrast are on one side alone."""
    h, w = 256, 384
    g = torch.Generator().manual_seed(3)
    alpha = 0.4 + 0.02 * torch.rand(1, 1, h, w, generator=g)
    alpha[..., w // 2 :] += 0.3 * enlarged(torch.rand(1, 1, h // 8, w // 16, generator=g), 8)
    beta = alpha * torch.tensor(tint).view(1, -1, 1, 1)
    beta[..., w // 2 :] += 0.02 * torch.randn(beta[..., w // 2 :].shape, generator=g)
    beta[..., :4, :] = torch.linspace(0, 1, w)
    beta = torch.cat([beta[..., :4, :], beta], -2)[..., :h, :]

    def evaluate(x: torch.Tensor) -> Segments:
        valid = x[..., 1] < h // 4
        there = torch.where(valid[..., None], x + x.new_tensor([0.0, 4.0]), 0.0)
        return Segments(there, there, valid)

    field = FieldOnGrid.evaluated(evaluate, (h, w), 1)
    inputs = replace(Inputs.from_images(alpha, [beta], [field]), multiple=16)
    facts = torch.zeros(1, 3, h // 2, w // 2)
    matches = Matches((BetaMatches(torch.zeros_like(alpha), facts, Comparison.from_images(alpha, beta)),))
    (whole,) = transferred(inputs, matches).betas
    monkeypatch.setattr(inputs_module, "SETTINGS", InputsSettings(halo=64, at_once=40_000))
    assert len({piece.outer[0] for piece in inputs.pieces}) > 1 < len({p.outer[2] for p in inputs.pieces})
    (pieces,) = transferred(inputs, matches).betas
    for one, other in (
        (whole.carried.bands, pieces.carried.bands),
        (whole.carried.fills[:, 0], pieces.carried.fills[:, 0]),
    ):
        assert (one - other).abs().max() < 0.1
    assert (whole.carried.weight - pieces.carried.weight).abs().mean() < 0.03
    assert float(whole.carried.bands[..., h // 2 :, :].std((-2, -1)).max()) < 1e-6


H, W = 64, 96
RED, BLUE = np.float32([0.3, -0.1, -0.1]), np.float32([-0.1, -0.1, 0.3])
ROWS = np.float64([[1, 0], [0, 0]])
"""All segments run along rows."""
UNSEEN = 40
"""Columns from the left that no beta sees."""


def coloured(first: np.ndarray) -> np.ndarray:
    """Red where it holds, else blue."""
    return np.where(first, RED[:, None, None], BLUE[:, None, None])


def hidden(colour: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """The colour with noise in place of the columns that are not seen, and the weight of each pixel."""
    weight = np.ones((H, W), np.float32)
    weight[:, :UNSEEN] = 0.0
    noise = np.random.default_rng(seed).random(colour.shape, np.float32)
    return np.where(weight > 0, colour, noise), weight


def bands_of_brightness() -> tuple[np.ndarray, np.ndarray]:
    """Alpha bright and dark in turn, in bands across, and its colours."""
    bright = np.broadcast_to((np.arange(H) // 16 % 2 == 0)[:, None], (H, W))
    return np.where(bright, np.float32(0.7), np.float32(0.3)), coloured(bright)


def bands_of_texture() -> tuple[np.ndarray, np.ndarray]:
    """Alpha of one mean brightness, rough and smooth in turn, and its colours."""
    rough = np.broadcast_to((np.arange(H) // 16 % 2 == 0)[:, None], (H, W))
    noise = np.random.default_rng(3).standard_normal((H, W)).astype(np.float32)
    return np.where(rough, np.float32(0.5) + np.float32(0.1) * noise, np.float32(0.5)), coloured(rough)


@pytest.mark.parametrize("scene", [bands_of_brightness, bands_of_texture])
def test_an_unseen_pixel_has_the_colour_of_the_seen_ones_most_alike(scene):
    alpha, colour = scene()
    found = by_examples(*hidden(colour)[:1], alpha, hidden(colour)[1], ROWS)
    inside = np.arange(H) % 16
    rows = (inside > 2) & (inside < 13)
    off = np.abs(found - colour)[:, rows, :UNSEEN]
    assert off.mean() < 0.02
    assert off.mean() < 0.1 * np.abs(colour - colour.mean((1, 2), keepdims=True)).mean()


def test_of_what_looks_alike_the_nearest_counts():
    alpha = np.full((H, 400), 0.5, np.float32)
    left = np.broadcast_to(np.arange(400) < 200, alpha.shape)
    colour, weight = coloured(left), np.ones_like(alpha)
    weight[:, 40:60] = weight[:, 340:360] = 0.0
    found = by_examples(np.where(weight > 0, colour, 0), alpha, weight, ROWS)
    assert np.abs(found - colour)[:, weight == 0].max() < 1e-3


def test_what_is_seen_stays_and_what_is_not_is_not_asked():
    alpha, colour = bands_of_brightness()
    (one, weight), (other, _) = hidden(colour, 1), hidden(colour, 2)
    found = by_examples(one, alpha, weight, ROWS)
    assert np.array_equal(found[:, :, UNSEEN:], colour[:, :, UNSEEN:])
    assert not np.array_equal(one, other)
    assert np.array_equal(found, by_examples(other, alpha, weight, ROWS))


def test_no_colour_is_invented():
    """A mean of colours that are there."""
    rng = np.random.default_rng(5)
    alpha, colour = rng.random((H, W), np.float32), rng.random((3, H, W), np.float32)
    weight = (rng.random((H, W)) > 0.4).astype(np.float32)
    found = by_examples(np.where(weight > 0, colour, -7), alpha, weight, ROWS)
    seen = colour[:, weight > 0]
    assert (found >= seen.min(1)[:, None, None] - 1e-6).all()
    assert (found <= seen.max(1)[:, None, None] + 1e-6).all()


def test_the_surer_a_pixel_is_the_more_it_counts():
    alpha = np.full((H, W), 0.5, np.float32)
    rows = np.broadcast_to((np.arange(H) // 2 % 2 == 0)[:, None], (H, W))
    colour, weight = coloured(rows), np.where(rows, np.float32(0.99), np.float32(0.55))
    weight[:, :UNSEEN] = 0.0
    found = by_examples(colour, alpha, weight, ROWS)[:, 8:-8, 4 : UNSEEN - 4]
    share = (found[0] - BLUE[0]) / (RED[0] - BLUE[0])
    assert share.mean() == pytest.approx(0.99 / (0.99 + 0.55), abs=0.05)


@pytest.mark.parametrize("count", [0, SETTINGS.neighbours - 1])
def test_with_few_seen_pixels_colour_is_returned_as_it_is(count):
    alpha, colour = bands_of_brightness()
    weight = np.zeros((H, W), np.float32)
    weight[0, : 2 * count : 2] = 1.0
    assert np.array_equal(by_examples(colour, alpha, weight, ROWS), colour)
    weight[:] = 1.0
    assert np.array_equal(by_examples(colour, alpha, weight, ROWS), colour)


def test_of_many_seen_pixels_some_are_searched_and_all_unseen_ones_filled(monkeypatch):
    """A large unseen region, of far more seen pixels than are searched."""
    h, w = 480, 640
    bright = np.broadcast_to((np.arange(h) // 32 % 2 == 0)[:, None], (h, w))
    alpha, colour = np.where(bright, np.float32(0.7), np.float32(0.3)), coloured(bright)
    weight = np.ones((h, w), np.float32)
    weight[:, :400] = 0.0
    searched = []
    search = warped.nearest_points
    monkeypatch.setattr(warped, "SETTINGS", replace(SETTINGS, sources=2000))
    monkeypatch.setattr(warped, "nearest_points", lambda x, *of: searched.append(len(x)) or search(x, *of))
    found = by_examples(np.where(weight > 0, colour, np.float32(9)), alpha, weight, ROWS)
    assert len(searched) == 1
    assert 500 < searched[0] <= 2000
    rows = (np.arange(h) % 32 > 3) & (np.arange(h) % 32 < 28)
    assert np.abs(found - colour)[:, rows].max() < 0.05


def test_the_same_is_found_again():
    rng = np.random.default_rng(7)
    alpha = cv2.GaussianBlur(rng.random((H, W), np.float32), (0, 0), 2.0)
    colour, weight = hidden(rng.random((3, H, W), np.float32))
    first, second = (by_examples(colour, alpha, weight, ROWS) for _ in range(2))
    assert np.array_equal(first, second)


def test_fills_of_a_batch_are_of_each_image():
    """Examples of one image serve no other; nor does the regression on brightness for any bands."""
    alpha, colour = (torch.from_numpy(x.copy()) for x in bands_of_brightness())
    weight = torch.from_numpy(hidden(colour.numpy())[1])[None, None].repeat(2, 1, 1, 1)
    both = torch.stack([colour, -colour]), torch.stack([alpha, 1 - alpha])[:, None], weight
    fills = filled_from(*both, ROWS, regressed=True)
    assert fills.shape == (2, 2, 3, H, W)
    for i in range(2):
        one = filled_from(*(part[i : i + 1] for part in both), ROWS, regressed=True)
        assert torch.equal(fills[i : i + 1], one)
    alone = filled_from(*both, ROWS, regressed=False)
    assert alone.shape == (2, 1, 3, H, W)
    by_example = by_examples(colour.numpy(), alpha.numpy(), weight[0, 0].numpy(), ROWS)
    assert np.array_equal(alone[0, 0].numpy(), by_example)
    rows = (torch.arange(H) % 16 > 2) & (torch.arange(H) % 16 < 13)
    for fill in (*fills[0], alone[0, 0]):
        assert (fill - colour)[:, rows, :UNSEEN].abs().mean() < 0.05


def test_examples_along_segments_count_as_nearer():
    """All of one brightness: the unseen middle has a colour 50 pixels along, and one 40 pixels across."""
    alpha, weight = np.full((121, 121), 0.5, np.float32), np.zeros((121, 121), np.float32)
    colour = np.zeros((3, 121, 121), np.float32)
    for (y, x), tint in {(60, 10): RED, (20, 60): BLUE}.items():
        spot = np.s_[y - 4 : y + 5, x - 4 : x + 5]
        weight[spot] = 1.0
        colour[(slice(None), *spot)] = tint[:, None, None]
    middle = (slice(None), 60, 60)
    for directions, along, across in ((ROWS, RED, BLUE), (ROWS[::-1, ::-1], BLUE, RED)):
        tint = by_examples(colour, alpha, weight, directions)[middle]
        assert np.abs(tint - along).max() < np.abs(tint - across).max()
    turned = by_examples(colour.transpose(0, 2, 1), alpha, weight.T, ROWS[::-1, ::-1])
    assert np.abs(turned[middle] - by_examples(colour, alpha, weight, ROWS)[middle]).max() < 1e-5


def test_directions_are_the_valid_segments():
    start, step = torch.zeros(32, 32, 2), torch.tensor([3.0, 4.0])
    valid = torch.arange(32)[:, None].expand(32, 32) < 24
    end = torch.where(valid[..., None], start + step, start - torch.tensor([9.0, 0.0]))
    found = directions_of(Segments(start[None], end[None], valid[None]))
    assert np.abs(found - np.outer([0.6, 0.8], [0.6, 0.8])).max() < 1e-6
    none = directions_of(Segments(start[None], end[None], torch.zeros(1, 32, 32, dtype=torch.bool)))
    assert np.array_equal(none, np.eye(2) / 2)
