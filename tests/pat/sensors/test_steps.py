import math

import cv2
import numpy as np
import pytest
import torch

from arraygeom.camera import Camera, intrinsics
from arraygeom.pose import Pose
from arraygeom.sensor import Band, Curve
from experiments.sensors import DecodeSRGB, EncodeSRGB, Exposure, Mosaic, MotionBlur, Spectral
from pat.sensors import (
    BoxBlur,
    Clip,
    GaussianBlur,
    Jitter,
    Noise,
    Quantise,
    Resample,
    augment,
    record,
)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def noise_image(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=generator(), dtype=torch.float64)


def run(image: torch.Tensor, *steps, seed: int = 0) -> torch.Tensor:
    return record(image, steps, generator(seed))


def test_linear_and_srgb_encoded_are_inverses_and_match_the_standard():
    x = torch.linspace(0, 1, 101, dtype=torch.float64).view(1, 1, 1, -1)
    torch.testing.assert_close(run(x, DecodeSRGB(), EncodeSRGB()), x, atol=1e-12, rtol=0)
    assert run(torch.full((1, 1, 1, 1), 0.5), DecodeSRGB()).item() == pytest.approx(0.214041, abs=1e-6)


def test_noise_follows_the_mean_variance_line():
    full_well, read = 1000.0, 8.0
    signal = torch.linspace(0.05, 0.95, 10, dtype=torch.float64).view(10, 1, 1, 1).expand(10, 1, 300, 300)
    noisy = run(signal, Noise(full_well, read))
    electrons = noisy.flatten(1) * full_well
    slope, offset = np.polyfit(electrons.mean(1).numpy(), electrons.var(1).numpy(), 1)
    assert slope == pytest.approx(1, abs=0.03)
    assert offset == pytest.approx(read**2, abs=10)


def test_noise_is_seeded_and_differs_between_images():
    flat = torch.full((2, 1, 4, 4), 0.5)
    a, b, c = (run(flat, Noise(100), seed=s) for s in (1, 1, 2))
    assert torch.equal(a, b)
    assert not torch.equal(a, c)
    assert not torch.equal(a[0], a[1])


@pytest.mark.parametrize("to", [0.5, 0.25, (20, 33), (50, 90), 2.0])
def test_area_resampling_keeps_the_mean(to):
    image = noise_image(2, 3, 40, 72)
    torch.testing.assert_close(run(image, Resample(to)).mean((2, 3)), image.mean((2, 3)))


def test_bicubic_resampling_keeps_the_mean_of_smooth_images():
    image = run(noise_image(1, 1, 80, 80), GaussianBlur(3.0))
    for to in (0.5, 2.0, (37, 61)):
        assert run(image, Resample(to, "bicubic")).mean() == pytest.approx(image.mean().item(), abs=1e-3)


def test_area_resampling_agrees_with_opencv():
    image = noise_image(1, 1, 60, 90)
    for hw in ((30, 45), (24, 60), (17, 29)):
        wanted = cv2.resize(image[0, 0].numpy(), hw[::-1], interpolation=cv2.INTER_AREA)
        np.testing.assert_allclose(run(image, Resample(hw))[0, 0].numpy(), wanted, atol=1e-6)


@pytest.mark.parametrize("method", ["area", "bicubic"])
@pytest.mark.parametrize("to", [0.5, 0.25, (31, 70), 2.0])
def test_points_stay_where_the_camera_of_the_resampled_image_puts_them(method, to):
    """A soft dot drawn where a point projects is found where the mapped camera projects the point."""
    K = intrinsics(90.0, (64, 96))
    camera = Camera(K=K, cam_from_world=Pose.identity(), hw=(64, 96))
    X = torch.tensor([0.13, -0.07, 1.0], dtype=torch.float64)
    x, y = camera.project(X).x
    rows, columns = torch.meshgrid(torch.arange(64.0), torch.arange(96.0), indexing="ij")
    dot = torch.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 4**2)).double()[None, None]
    image = run(dot, GaussianBlur(1.0), Resample(to, method))
    new = camera.transformed(Resample(to, method).pixel_matrix((64, 96)), tuple(image.shape[-2:]))
    rows, columns = torch.meshgrid(*(torch.arange(float(n)) for n in image.shape[-2:]), indexing="ij")
    found = [(image[0, 0] * c).sum() / image.sum() for c in (columns, rows)]
    torch.testing.assert_close(torch.stack(found), new.project(X).x, atol=0.01, rtol=0)


def test_blurs_keep_flat_images_and_diffuse_a_point_as_stated():
    point = torch.zeros(1, 1, 41, 41, dtype=torch.float64)
    point[..., 20, 20] = 1
    x = torch.arange(41.0).double() - 20
    for step, variance in ((BoxBlur(5), 2.0), (GaussianBlur(2.0), 4.0)):
        assert torch.allclose(run(torch.ones(1, 2, 9, 9), step), torch.ones(1, 2, 9, 9))
        spread = run(point, step)[0, 0]
        assert spread.sum().item() == pytest.approx(1)
        assert (spread.sum(0) * x**2).sum().item() == pytest.approx(variance, rel=0.03)
        assert (spread.sum(1) * x**2).sum().item() == pytest.approx(variance, rel=0.03)


def test_blurs_agree_with_opencv():
    image = noise_image(1, 1, 30, 40)
    box = cv2.blur(image[0, 0].numpy(), (5, 5), borderType=cv2.BORDER_REPLICATE)
    np.testing.assert_allclose(run(image, BoxBlur(5))[0, 0].numpy(), box, atol=1e-12)
    gauss = cv2.GaussianBlur(image[0, 0].numpy(), (13, 13), 1.5, borderType=cv2.BORDER_REPLICATE)
    np.testing.assert_allclose(run(image, GaussianBlur(1.5))[0, 0].numpy(), gauss, atol=1e-12)


def test_spectral_responses():
    image = noise_image(2, 3, 4, 5)
    assert torch.equal(run(image, Spectral("rgb")), image)
    grey = run(image, Spectral("luminance"))
    wanted = np.stack([cv2.cvtColor(i.movedim(0, -1).float().numpy(), cv2.COLOR_RGB2GRAY) for i in image])
    np.testing.assert_allclose(grey[:, 0].numpy(), wanted, atol=1e-4)
    white = torch.ones(1, 3, 1, 1)
    for centre in (450, 550, 600):
        assert run(white, Spectral(Band(centre, 40))).item() == pytest.approx(1)
    red = torch.tensor([1.0, 0, 0]).view(1, 3, 1, 1)
    assert run(red, Spectral(Band(620, 20))).item() > 0.85 > 0.1 > run(red, Spectral(Band(450, 20))).item()


def test_responses_of_a_image_with_near_infrared():
    image = noise_image(2, 4, 4, 5)
    assert torch.equal(run(image, Spectral("rgb")), image[:, :3])
    assert torch.equal(run(image, Spectral("nir")), image[:, 3:])
    torch.testing.assert_close(run(image, Spectral("luminance")), run(image[:, :3], Spectral("luminance")))
    torch.testing.assert_close(run(image, Spectral(Band(850, 20))), image[:, 3:], atol=2e-3, rtol=0)
    between = run(torch.tensor([1.0, 0, 0, 0]).view(1, 4, 1, 1), Spectral(Band(700, 200))).item()
    assert 0.2 < between < 0.8


def test_a_curve_that_samples_a_band_weighs_as_the_band():
    band = Band(560, 50)
    nm = np.linspace(350, 1000, 651)
    curve = Curve(tuple(nm), tuple(np.exp(-4 * np.log(2) * ((nm - band.centre) / band.width) ** 2)))
    image = noise_image(2, 4, 4, 5)
    torch.testing.assert_close(run(image, Spectral(curve)), run(image, Spectral(band)), atol=1e-6, rtol=0)


def test_motion_blur_is_as_long_as_shutter_times_velocity_and_stays_centred():
    """A box of length L has variance L^2 / 12; looking up between pixels adds at most 1/4."""
    point = torch.zeros(1, 1, 61, 81, dtype=torch.float64)
    point[0, 0, 30, 40] = 1
    spread = run(point, MotionBlur(0.02, (600.0, 0.0)))[0, 0]
    x = torch.arange(81.0).double() - 40
    assert spread.sum().item() == pytest.approx(1)
    assert (12 * (spread.sum(0) * x**2).sum().item()) ** 0.5 == pytest.approx(12, rel=0.05)
    assert spread[30].sum().item() == pytest.approx(1, abs=1e-9)
    assert (spread.sum(0) * x).sum().item() == pytest.approx(0, abs=1e-9)


def test_motion_blur_agrees_with_a_line_filter_of_opencv():
    image = noise_image(1, 1, 61, 81)
    mean = cv2.blur(image[0, 0].numpy(), (9, 1), borderType=cv2.BORDER_REPLICATE)
    sampled = run(image, MotionBlur(1.0, (9.0, 0.0)))[0, 0].numpy()
    assert np.abs(sampled - mean).max() < 0.06
    assert np.abs(sampled - mean).mean() < 0.01


def test_quantise_rounds_to_levels():
    image = noise_image(1, 1, 8, 8) * 1.2 - 0.1
    levels = run(image, Quantise(4)) * 15
    torch.testing.assert_close(levels, levels.round())
    assert (run(image, Quantise(8)) - image.clamp(0, 1)).abs().max() <= 0.5 / 255 + 1e-12


def test_jitter_changes_each_image_by_about_what_is_asked():
    grey = torch.full((4000, 3, 1, 1), 0.4)
    jittered = run(grey, Jitter(gain=0.05, gamma=0.0, normalisation=0.0))
    assert (jittered / 0.4).log().std().item() == pytest.approx(0.05, rel=0.05)
    assert (jittered.std(1) < 1e-6).all()
    assert (run(grey, Jitter(0.0, 0.0, 0.05)).std(1) > 1e-3).float().mean() > 0.9


@pytest.mark.parametrize(
    "step",
    [
        *(DecodeSRGB(), EncodeSRGB(), Exposure(1.7), Spectral("luminance"), Spectral(Band(560, 50))),
        *(BoxBlur(3), GaussianBlur(0.8), MotionBlur(1.0, (2.3, -1.1)), Resample(0.5), Resample((5, 9))),
        *(Resample(2.0, "bicubic"), Mosaic("GRBG"), Noise(500, 3), Jitter()),
    ],
    ids=lambda step: type(step).__name__,
)
def test_gradients_in_the_image(step):
    image = (0.1 + 0.8 * noise_image(1, 3, 6, 8)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: run(x, step), image)


@pytest.mark.parametrize("step", [GaussianBlur, Exposure])
def test_gradients_in_the_parameter(step):
    image = noise_image(1, 1, 9, 9)
    parameter = torch.tensor(1.23, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p: run(image, step(p)), parameter)


def test_quantise_lets_the_gradient_pass_where_not_clipped():
    image = torch.tensor([-0.5, 0.3, 1.5]).view(1, 1, 1, 3).requires_grad_()
    run(image, Quantise(8)).sum().backward()
    assert image.grad.flatten().tolist() == [0, 1, 0]


def test_the_four_cases_are_equally_likely_and_do_what_they_say():
    alpha, beta = noise_image(400, 1, 8, 16), noise_image(400, 3, 8, 16)
    pairs = augment(alpha, beta, generator())
    assert (torch.bincount(pairs.case, minlength=4) - 100).abs().max() < 35
    before = ((pairs.alpha, alpha), (pairs.beta, beta))
    changed = torch.stack([(a != b).flatten(1).any(1) for a, b in before], 1)
    wanted = torch.tensor([[True, False], [False, True], [False, True], [False, True]])
    assert torch.equal(changed, wanted[pairs.case])
    for case, steps in ((1, [BoxBlur(5)]), (2, [Resample(0.5, "bicubic"), Resample(2.0, "bicubic"), Clip()])):
        met = pairs.case == case
        torch.testing.assert_close(pairs.beta[met], run(beta[met], *steps))


def test_mistakes_are_named():
    with pytest.raises(ValueError, match="odd"):
        BoxBlur(4)
    with pytest.raises(ValueError, match="900 nm"):
        run(noise_image(1, 3, 4, 4), Spectral(Band(900, 20)))
    with pytest.raises(ValueError, match="NIR"):
        run(noise_image(1, 3, 4, 4), Spectral("nir"))
    with pytest.raises(ValueError, match="collects"):
        run(noise_image(1, 3, 4, 4), Spectral(Curve((1500.0, 1600.0), (1.0, 1.0))))
    for numbers in ((0.0, 0.0), (math.nan, 0.0), (100.0, math.nan), (math.inf, 0.0), (100.0, math.inf)):
        with pytest.raises(ValueError, match=r"full_well|read"):
            Noise(*numbers)

    for to in (0.0, math.nan, math.inf, (4, 0)):
        with pytest.raises(ValueError, match=r"to is|hw is"):
            Resample(to)
    for to in ((4, math.nan), (4,), (4.5, 4.0)):
        with pytest.raises((ValueError, TypeError), match=r"hw is|to="):
            Resample(to)
    with pytest.raises((ValueError, TypeError), match="method"):
        Resample(0.5, "bilinear")
    for wrong in ({"gain": -0.1}, {"gamma": math.nan}, {"normalisation": math.inf}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            Jitter(**wrong)
    with pytest.raises(ValueError, match="bits"):  # every value was NaN
        Quantise(0)
    for sigma in (-1.0, math.nan):
        with pytest.raises(ValueError, match="sigma"):
            GaussianBlur(sigma)
