"""Fusion of noisy views."""

import warnings
from dataclasses import replace
from functools import cache, partial

import pytest
import torch

import pat.fusion.low_light
import pat.fusion.tiles
from arraygeom import Pair, Rectified, Rig, View
from arraygeom.distortion import Distortion
from arraygeom.fields.grid import FieldOnGrid
from pat import FuseSettings, fuse
from pat.fusion.classical import classical, non_local_means
from pat.fusion.corrections import find_corrections
from pat.fusion.inputs import FrameInputs, Placement
from pat.fusion.low_light import (
    Brightness,
    NoisyView,
    brightness,
    brightness_change,
    denoised,
    denoised_views,
    noise_levels,
    shown_noise,
    warped,
)
from pat.fusion.tiles import Tile, fuse_tile
from pat.fusion.views import Views
from pat.matching.band_mix import Response
from pat.matching.inputs import Beta, Inputs
from pat.media.colour import luminance
from pat.networks.protocol import FusionOutput
from pat.networks.weights import load_weights
from pat.sensors import NoiseLevel, generator_for
from pat.support.metrics import score
from pat.support.steps import steps_shown
from tests.pat.layered_array import ALPHA, BETA, load_sample, middle_of_sample


@pytest.fixture(scope="module")
def network():
    return load_weights("mono-colour")


def in_low_light(electrons, of=middle_of_sample):
    """The middle of the sample, or all of it; its images with noise; and the levels of that."""
    sample, level = of(), NoiseLevel.from_electrons(electrons, 2)
    images = {n: level.recorded(i[None], generator_for(0, n))[0] for n, i in sample.images.items()}
    return sample, images, dict.fromkeys(images, level)


@pytest.fixture(scope="module")
def fused(network):
    """The middle of the sample fused, by its electrons at white and whether they are told, each once."""

    @cache
    def of(electrons, *, told=True):
        sample, images, noise = in_low_light(electrons)
        return fuse(
            images,
            sample.rig,
            alpha=ALPHA,
            network=network,
            settings=FuseSettings(noise=noise if told else "estimate"),
        )

    return of


def psnr(image, sample):
    return score(image.clamp(0, 1), sample.ground_truth).psnr


@pytest.mark.parametrize("noise", [{}, {ALPHA: NoiseLevel.from_electrons(1e6)}])
def test_views_without_noticeable_noise_are_fused_as_ever(network, noise):
    sample = middle_of_sample()
    plain, same = (
        fuse(sample.images, sample.rig, alpha=ALPHA, network=network, settings=FuseSettings(noise=n))
        for n in (None, noise)
    )
    assert torch.equal(plain.image, same.image)
    assert torch.equal(plain.confidence, same.confidence)


@pytest.mark.parametrize(("electrons", "gain", "margin"), [(200, 3.5, 0.5), (50, 6.5, 1.2)])
def test_low_light_against_the_classical_baseline_and_denoising_before_it(fused, electrons, gain, margin):
    sample, images, _ = in_low_light(electrons)
    ours = psnr(fused(electrons).image, sample)
    assert ours > psnr(classical(sample.rig, images, ALPHA, BETA), sample) + gain
    quiet = {n: non_local_means(i, float((i - sample.images[n]).std())) for n, i in images.items()}
    assert ours > psnr(classical(sample.rig, quiet, ALPHA, BETA), sample) + margin


def test_an_estimated_level_does_about_as_well_as_a_stated_one(fused):
    sample = middle_of_sample()
    assert psnr(fused(50, told=False).image, sample) > psnr(fused(50).image, sample) - 0.5


def test_averaged_colours_improve_on_denoising_alone(network, fused, monkeypatch):
    sample, images, noise = in_low_light(50)
    averaged = fused(50).image
    monkeypatch.setattr("pat.fusion.low_light.averaged_with_alike", lambda image, *_: image)
    alone = fuse(images, sample.rig, alpha=ALPHA, network=network, settings=FuseSettings(noise=noise)).image
    assert psnr(averaged, sample) > psnr(alone, sample) + 0.02


@pytest.mark.parametrize(("electrons", "gain"), [(50, 0.05), (5000, 0.5)])
def test_a_betas_light_improves_on_alphas_brightness(network, monkeypatch, electrons, gain):
    """The more, the more of it there is: of so many electrons where alpha has 50."""
    sample, images, noise = in_low_light(50)
    noise[BETA] = NoiseLevel.from_electrons(electrons, 2)
    images[BETA] = noise[BETA].recorded(sample.images[BETA][None], generator_for(0, BETA))[0]
    joined = fuse(images, sample.rig, alpha=ALPHA, network=network, settings=FuseSettings(noise=noise)).image
    monkeypatch.setattr("pat.fusion.low_light.other_camera_update", lambda estimate, *_: 0 * estimate)
    alone = fuse(images, sample.rig, alpha=ALPHA, network=network, settings=FuseSettings(noise=noise)).image
    seen, denoised, true = map(luminance, (joined, alone, sample.ground_truth))
    assert float((seen - true).square().mean()) < 10 ** (-gain / 10) * float(
        (denoised - true).square().mean()
    )


def test_each_beta_adds_what_it_saw():
    """One after another, where its matches are certain; a beta that is shifted, at its matches."""
    y, x = torch.meshgrid(torch.arange(40.0), torch.arange(60.0), indexing="ij")
    clean = (0.5 + 0.03 * torch.sin(0.6 * x + 0.3 * y))[None, None]
    estimate = 0.5 + 0.6 * (clean - 0.5)
    alpha = NoisyView(estimate, estimate, torch.full_like(clean, 0.2))
    grain = torch.randn(clean.shape, generator=generator_for(0))
    betas = [Brightness(image, 0.01 + 0 * clean, grain) for image in (clean, clean.roll(5, -1))]
    left, right = (torch.stack([x + move, y, c.to(x)]) for move, c in ((0, x < 30), (5, x >= 30)))
    right[0].clamp_(max=59)
    change = brightness_change(alpha, betas, torch.stack([left, right]))
    before, after = ((image - clean).abs()[0, 0, 8:-8] for image in (estimate, estimate + change))
    for part in (slice(8, 25), slice(35, 50)):
        assert float(after[:, part].mean()) < 0.7 * float(before[:, part].mean())


def test_brightness_is_of_what_alpha_sees():
    """Its response; independent noise of the bands; grain of unit deviation."""
    view = NoisyView(*(torch.rand(1, 3, 40, 50, generator=generator_for(0, i)) for i in range(3)))
    grain = torch.randn(1, 3, 40, 50, generator=generator_for(1))
    found = brightness(view, grain, Response(torch.tensor([0.6, 0.3, 0.1])))
    red, green, blue = view.recorded[0]
    torch.testing.assert_close(found.recorded[0, 0], 0.6 * red + 0.3 * green + 0.1 * blue)
    bands = view.deviation[0] * torch.tensor([0.6, 0.3, 0.1])[:, None, None]
    torch.testing.assert_close(found.deviation[0, 0], bands.square().sum(0).sqrt())
    assert float(found.grain.std()) == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_brightness_that_no_beta_explains_is_alphas_alone(network, monkeypatch, share):
    sample, images, noise = in_low_light(200)
    monkeypatch.setattr("pat.fusion.fuse.find_corrections", partial(find_corrections_explaining, share))
    asked = []
    monkeypatch.setattr("pat.fusion.low_light.brightness_change", lambda alpha, *_: asked.append(alpha) or 0)
    fuse(images, sample.rig, alpha=ALPHA, network=network, settings=FuseSettings(noise=noise))
    assert len(asked) == (share == 1.0)


def find_corrections_explaining(share, *args, **options):
    found = find_corrections(*args, **options)
    return replace(found, response=Response.rec601()._replace(explained=share))


@pytest.mark.parametrize("given", [(ALPHA, BETA), (BETA,)])
def test_alphas_values_are_kept(network, given):
    """Asked for, or because no noise of alpha is stated."""
    sample, images, noise = in_low_light(200)
    noise = {name: noise[name] for name in given}
    frame = fuse(
        images,
        sample.rig,
        alpha=ALPHA,
        network=network,
        settings=FuseSettings(noise=noise, keep_alpha=ALPHA in given),
    )
    torch.testing.assert_close(luminance(frame.image), images[ALPHA], atol=1e-4, rtol=0)


def test_tiles_are_denoised_as_the_whole(network, fused, monkeypatch):
    """But for equal blocks: rounding chooses, then a match may differ."""
    _, images, noise = in_low_light(200, load_sample)
    view, level = images[ALPHA][None, :, 120:280], noise[ALPHA]
    views = view, level.deviation(view)
    whole = denoised(*views)
    ordinary_tiles = pat.fusion.low_light.in_tiles
    monkeypatch.setattr("pat.fusion.low_light.in_tiles", partial(ordinary_tiles, rows=320))
    pieces, ordinary = [], pat.fusion.low_light.without_noise
    monkeypatch.setattr("pat.fusion.low_light.without_noise", lambda *a: pieces.append(a) or ordinary(*a))
    tiles = denoised(*views)
    assert len(pieces) == 2
    torch.testing.assert_close(tiles, whole, atol=5e-3, rtol=0)
    assert float(((tiles - whole).abs() > 1e-3).float().mean()) < 1e-3
    sample, images, noise = in_low_light(200)
    monkeypatch.setattr("pat.fusion.low_light.in_tiles", partial(ordinary_tiles, rows=160))
    in_tiles = fuse(images, sample.rig, alpha=ALPHA, network=network, settings=FuseSettings(noise=noise))
    assert len(pieces) > 6
    assert float(((in_tiles.image - fused(200).image).abs() > 2e-3).float().mean()) < 0.01


def test_a_distorted_alpha_is_denoised_too(network):
    sample, images, noise = in_low_light(50)
    lens = Distortion("brown-conrady", torch.tensor([-0.05, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    rig = sample.rig.with_camera(ALPHA, sample.rig[ALPHA].replace(distortion=lens))
    frame = fuse(images, rig, alpha=ALPHA, network=network, settings=FuseSettings(noise=noise))
    recorded, found = (
        float((x - x.roll(1, -1)).square().mean()) for x in (images[ALPHA], luminance(frame.image))
    )
    assert frame.image.shape == sample.ground_truth.shape
    assert found < 0.5 * recorded


def test_noisy_bands_at_one_position_are_joined():
    """To one beta of three bands, in the rig's order, nearer the ground truth than fused as recorded."""
    sample, images, noise = in_low_light(200, load_sample)
    cameras = {ALPHA: sample.rig[ALPHA], **dict.fromkeys(("r", "g", "b"), sample.rig[BETA])}
    rig = Rig(cameras, depth=sample.rig.depth).crop(ALPHA, 100, 200, (160, 200))
    for name in "rgb":
        rig = rig.crop(name, 90, 140, (140, 200))
    seen = {
        ALPHA: images[ALPHA][:, 100:260, 200:400],
        **dict(zip("rgb", images[BETA][:, 90:230, 140:340].split(1))),
    }
    noise = {ALPHA: noise[ALPHA], **dict.fromkeys("rgb", noise[BETA])}
    network = load_weights("mono-spectral")
    recorded, quiet = (
        fuse(seen, rig, alpha=ALPHA, network=network, settings=FuseSettings(noise=n)).image
        for n in (None, noise)
    )
    wanted = sample.ground_truth[:, 100:260, 200:400]
    one, other = (
        [score(i[None].clamp(0, 1), w[None]).psnr for i, w in zip(x, wanted)] for x in (recorded, quiet)
    )
    assert all(after > before + 2 for before, after in zip(one, other))


def test_bands_other_than_three_are_denoised_one_by_one():
    image, deviation = torch.rand(1, 2, 40, 40), torch.full((1, 2, 40, 40), 0.05)
    both = denoised(image, deviation)
    torch.testing.assert_close(both[:, 1:], denoised(image[:, 1:], deviation[:, 1:]))


def test_a_camera_without_an_image_is_named():
    sample = load_sample()
    views = Views.of(sample.rig, sample.images, alpha=ALPHA)
    with pytest.raises(ValueError, match="'nir'"):
        denoised_views(views, {"nir": NoiseLevel(0.01)})


def test_noise_stated_far_beyond_what_the_image_shows_is_said():
    sample, images, noise = in_low_light(200)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        denoised_views(Views.of(sample.rig, images, alpha=ALPHA), noise)
    wrong = {ALPHA: NoiseLevel.from_electrons(2)}
    said = f"noise of '{ALPHA}': a standard deviation of .* is stated, its image shows"
    with pytest.warns(UserWarning, match=said):
        denoised_views(Views.of(sample.rig, sample.images, alpha=ALPHA), wrong)


def test_what_is_held_for_low_light_is_planned_for(network):
    sample, images, noise = in_low_light(200)
    plans = []

    def end_there(plan):
        plans.append(plan)
        raise InterruptedError

    for given in (None, noise):
        with pytest.raises(InterruptedError):
            fuse(
                images,
                sample.rig,
                alpha=ALPHA,
                network=network,
                settings=FuseSettings(noise=given),
                announce=end_there,
            )
    views = sum(image.nbytes for image in images.values())
    assert plans[1].memory > plans[0].memory + 4 * views


def test_the_time_announced_has_the_correction_in_it(network, monkeypatch):
    sample, images, noise = in_low_light(200)
    monkeypatch.setattr(pat.fusion.tiles, "ESTIMATED", 0)
    slow = replace(pat.fusion.low_light.SETTINGS, averaging=1e4)
    monkeypatch.setattr(pat.fusion.low_light, "SETTINGS", slow)
    plans, steps = [], []
    with steps_shown(steps.append):
        fuse(
            images,
            sample.rig,
            alpha=ALPHA,
            network=network,
            settings=FuseSettings(noise=noise),
            announce=plans.append,
        )
    assert plans[0].seconds > 1e3
    wanted = [f"denoising {name}" for name in (*images, "the fused image")]
    assert [s.split(" (")[0] for s in steps if "denoising" in s] == wanted


def test_betas_are_mixed_by_confidence():
    one, other = (NoisyView(*torch.full((3, 1, 3, 4, 5), value).unbind()) for value in (0.2, 0.8))
    where = torch.stack(torch.meshgrid(torch.arange(5.0), torch.arange(4.0), indexing="xy"), -1)
    seen = torch.zeros(4, 5)
    seen[:, 2:] = 0.9
    found = torch.stack([torch.cat([where.movedim(-1, 0), c[None]]) for c in (seen, 0.9 - seen)])
    mixed, confidence = warped([one, other], found)
    torch.testing.assert_close(mixed.recorded[0, 0, :, 2:], torch.full((4, 3), 0.2), atol=1e-4, rtol=0)
    torch.testing.assert_close(mixed.recorded[0, 0, :, :2], torch.full((4, 2), 0.8), atol=1e-4, rtol=0)
    assert float(confidence.min()) == pytest.approx(0.9)


def test_positions_of_parts_are_in_the_whole_betas(network, monkeypatch):
    ones = torch.ones(1, 2, 4, 5)
    output = FusionOutput(torch.zeros(1, 3, 4, 5), [ones], [ones[:, 0]], [0.5 * ones[:, 0]])
    monkeypatch.setattr(network, "forward", lambda inputs, matches=None: output)
    pair = Pair(View(hw=(4, 5)), View(hw=(4, 5)))
    part = Beta(torch.zeros(1, 3, 4, 5), FieldOnGrid.from_field(Rectified(3.0), pair), offset=(7, 2))
    frame = FrameInputs(Inputs(torch.zeros(1, 1, 4, 5), (part,)), [Placement(pair, lambda x: x)], (4, 5))
    whole = (0, 4, 0, 5)
    monkeypatch.setattr(Inputs, "cut", lambda self, box: self)
    found = fuse_tile(network, frame, None, Tile(whole, whole)).matched
    assert found[0, :, 1, 1].tolist() == [8.0, 3.0, 0.5]


def test_positions_are_those_of_the_matched_colours(network, monkeypatch):
    """Beta's own colours at the positions that are found resemble the fused image."""
    sample, images, noise = in_low_light(200)
    seen = {}

    def noted(image, betas, found):
        beta, confidence = warped(betas, found)
        seen.update(image=image[None], beta=beta, confidence=confidence)
        return image

    monkeypatch.setattr("pat.fusion.low_light.colours_averaged", noted)
    fuse(images, sample.rig, alpha=ALPHA, network=network, settings=FuseSettings(noise=noise))
    high = (seen["confidence"] > 0.8).expand_as(seen["image"])
    assert float((seen["beta"].denoised - seen["image"])[high].abs().mean()) < 0.04


def test_a_darker_beta_keeps_its_colours(network, fused):
    """The joint correction saw a beta at its own exposure, and pulled colours towards its darker ones."""
    sample, images, noise = in_low_light(200)
    darker = noise[BETA].recorded(0.5 * sample.images[BETA][None], generator_for(0, BETA))[0]
    dark = fuse(
        {**images, BETA: darker}, sample.rig, alpha=ALPHA, network=network, settings=FuseSettings(noise=noise)
    )
    bright, dark = (float((f.image.amax(0) - f.image.amin(0)).mean()) for f in (fused(200), dark))
    assert dark == pytest.approx(bright, rel=0.1)


def test_noise_that_shows_plainly_is_removed_unasked(network, fused):
    sample, images, _ = in_low_light(200)
    said: list[str] = []
    frame = fuse(
        images,
        sample.rig,
        alpha=ALPHA,
        network=network,
        settings=FuseSettings(noise="auto"),
        explain=said.append,
    )
    assert torch.equal(frame.image, fused(200, told=False).image)
    assert sum(line.startswith("noise shows plainly and is removed: mono ") for line in said) == 1
    clean = {name: image * 255 // 1 / 255 for name, image in sample.images.items()}
    assert max(map(shown_noise, clean.values())) < 4 / 255
    assert not noise_levels(clean, "auto")
    assert noise_levels({}, "auto") == {}


@pytest.mark.parametrize("bands", [2, 3])
def test_the_denoiser_is_where_the_image_is(bands, monkeypatch):
    def without_noise(denoise, image, deviation):
        assert {weights.device for weights in denoise.parameters()} == {image.device}
        return image

    monkeypatch.setattr("pat.fusion.low_light.without_noise", without_noise)
    for device in ("meta", "cpu"):
        image = torch.zeros(1, bands, 16, 16, device=device)
        assert denoised(image, image).device.type == device
