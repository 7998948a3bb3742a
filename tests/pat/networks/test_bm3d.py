"""Groups of alike blocks, filtered together."""

import numpy as np
import pytest
import torch
from scipy.fft import dctn, idctn
from scipy.linalg import hadamard
from torch.nn.functional import avg_pool2d, pad

from arraygeom.runtime.threads import limited_to
from pat.networks.bm3d import (
    ALIKE,
    RADIUS,
    SETTINGS,
    SIDE,
    STEP,
    WINDOW,
    Observation,
    other_camera_update,
    refined,
    wiener_filtered,
)
from pat.sensors import generator_for

HADAMARD = hadamard(ALIKE) / ALIKE**0.5


def noise_of(shape, seed, deviation=1.0):
    return deviation * torch.randn(shape, generator=generator_for(seed))


def stripes(bands, hw=(48, 64)):
    """Slanted stripes, so that there is something alike everywhere, of other contrast in each band."""
    y, x = torch.meshgrid(*(torch.arange(float(n)) for n in hw), indexing="ij")
    wave = 0.5 + 0.2 * torch.sin(0.6 * x + 0.3 * y)
    return torch.stack([wave * c for c in (1.0, 0.7, 0.9)[:bands]])


def to_groups(blocks):
    return np.einsum("mn,nij->mij", HADAMARD, dctn(blocks, axes=(1, 2), norm="ortho"))


def padded(*planes):
    n = RADIUS + SIDE
    margins = [(0, 0), (n, n + SIDE), (n, n + SIDE)]
    return [np.pad(t.double().numpy(), margins, mode="symmetric") for t in planes]


def groups_of(alike, hw):
    """For each block: where the most alike ones are, by `padded` planes of the guide."""
    n, (h, w) = RADIUS + SIDE, hw
    for y in range(n - SIDE + STEP, n + h, STEP):
        for x in range(n - SIDE + STEP, n + w, STEP):
            places = [(y + i, x + j) for i in range(-RADIUS, RADIUS + 1) for j in range(-RADIUS, RADIUS + 1)]
            own = alike[:, y : y + SIDE, x : x + SIDE]
            places.sort(key=lambda p: ((alike[:, p[0] : p[0] + SIDE, p[1] : p[1] + SIDE] - own) ** 2).sum())
            yield places[:ALIKE]


def transformed(plane, places):
    return to_groups(np.stack([plane[i : i + SIDE, j : j + SIDE] for i, j in places]))


def accumulate(group, counts, places, total, weights):
    blocks = idctn(np.einsum("nm,mij->nij", HADAMARD.T, group), axes=(1, 2), norm="ortho")
    for (i, j), block in zip(places, blocks):
        total[i : i + SIDE, j : j + SIDE] += counts * WINDOW * block
        weights[i : i + SIDE, j : j + SIDE] += counts * WINDOW


def inside(total, weights, hw):
    n = RADIUS + SIDE
    there = np.s_[..., n : n + hw[0], n : n + hw[1]]
    return torch.from_numpy(total[there] / weights[there]).float()


def directly(image, expected, guide, deviation):
    """The same as it is defined, block by block."""
    hw = image.shape[1:]
    seen, known, alike, noise = padded(image, expected, guide, deviation.square())
    total, weights = np.zeros_like(seen), np.zeros_like(seen)
    for places in groups_of(alike, hw):
        for c in range(len(image)):
            blocks, model = (transformed(t[c], places) for t in (seen, known))
            variance = np.mean([noise[c, i + 4, j + 4] for i, j in places])
            share = model**2 / (model**2 + variance)
            counts = 1 / (variance + 1e-8) / (1 + np.square(1.0 * share).sum())
            accumulate(blocks * share, counts, places, total[c], weights[c])
    return inside(total, weights, hw)


def every_block(plane):
    windows = np.lib.stride_tricks.sliding_window_view(plane[0].double().numpy(), (SIDE, SIDE))
    return dctn(windows.reshape(-1, SIDE, SIDE), axes=(1, 2), norm="ortho")


def update_directly(estimate, recorded, deviation, other):
    """The update by another camera's recording as it is defined, block by block."""
    own, seen, grain = (every_block(t) for t in (estimate, other.recorded, other.grain))
    sure = np.lib.stride_tricks.sliding_window_view(other.confidence[0].double().numpy(), (SIDE, SIDE))
    counts = np.square(sure.mean((-2, -1))).reshape(-1, 1, 1)
    blur = ((counts * own * seen).sum(0) / (counts * own**2).sum(0)).clip(0, 1)
    spectrum = (counts * grain**2).sum(0) / counts.sum()
    taken = estimate + other.confidence * (other.recorded - estimate)
    guide = (estimate + recorded) / 2
    planes = padded(estimate, taken, guide, deviation.square(), other.deviation.square(), other.confidence)
    known, there, alike, noise, others, confidence = planes
    total, weights = np.zeros_like(known[0]), np.zeros_like(known[0])
    for places in groups_of(alike, estimate.shape[1:]):
        variance, elsewhere, certain = (
            np.mean([t[0, i + 4, j + 4] for i, j in places]) for t in (noise, others, confidence)
        )
        model, group = (transformed(t[0], places) for t in (known, there))
        error = model**2 * variance / (model**2 + variance)
        unlike = (spectrum * elsewhere + SETTINGS.unlike * model**2) / certain**2
        gain = blur * error / (blur**2 * error + unlike)
        accumulate(gain * (group - blur * model), 1 / (1 + np.square(gain).sum()), places, total, weights)
    return inside(total, weights, estimate.shape[1:])[None]


def test_is_as_defined():
    clean = torch.rand(2, 21, 26, generator=generator_for(5))
    # In sixteenths: exact sums, so that of blocks equally alike, such as mirrored ones, both choose the
    # first.
    guide = torch.randint(17, (1, 21, 26), generator=generator_for(6)) / 16
    image, deviation = clean + noise_of(clean.shape, 7, 0.05), 0.05 + 0.02 * clean
    found = wiener_filtered(image, clean, deviation, guide)
    torch.testing.assert_close(found, directly(image, clean, guide, deviation), atol=1e-5, rtol=0)


def test_noise_goes_and_detail_stays():
    clean = stripes(1)
    image = clean + noise_of(clean.shape, 1, 0.05)
    found = wiener_filtered(image, clean, torch.full_like(clean, 0.05), image)
    assert (found - clean).square().mean() < 0.05 * 0.05**2


def test_without_noise_images_stay():
    clean = stripes(3)
    found = wiener_filtered(clean, clean, torch.zeros_like(clean), clean[:1])
    torch.testing.assert_close(found, clean, atol=1e-5, rtol=0)


@pytest.mark.parametrize("bands", [1, 3])
def test_an_estimate_is_refined(bands):
    """An estimate that still has noise of its own: less than half of its error is left."""
    clean = stripes(bands)
    recorded = (clean + noise_of(clean.shape, 2, 0.06))[None]
    estimate = clean + noise_of(clean.shape, 3, 0.03)
    found = refined(estimate[None], recorded, torch.full_like(recorded, 0.06))[0]
    assert (found - clean).square().mean() < 0.5 * (estimate - clean).square().mean()


def test_images_of_a_batch_are_refined_one_by_one():
    images = torch.stack([stripes(3), stripes(3).flip(-1)]) + noise_of((2, 3, 48, 64), 4, 0.05)
    deviation = torch.stack([torch.full((3, 48, 64), d) for d in (0.05, 0.1)])
    together = refined(images, images, deviation)
    alone = [refined(image[None], image[None], noise[None]) for image, noise in zip(images, deviation)]
    assert torch.equal(together, torch.cat(alone))


def test_the_result_does_not_depend_on_the_number_of_threads():
    image = torch.rand(3, 150, 40, generator=generator_for(9))
    deviation, found = torch.full_like(image, 0.1), []
    for threads in (1, 2, 5):
        with limited_to(threads):
            found.append(wiener_filtered(image, image, deviation, image[:1]))
    assert all(torch.equal(one, found[0]) for one in found[1:])


@pytest.mark.parametrize("hw", [(1, 1), (3, 50), (50, 3), (33, 40)])
def test_images_of_any_size(hw):
    image = torch.rand(1, *hw, generator=generator_for(1))
    found = wiener_filtered(image, image, torch.full_like(image, 0.01), image)
    assert found.shape == image.shape
    assert (found - image).abs().max() < 0.1


def observed(image, *, deviation=0.0, confidence=1.0, seed=11):
    """Return an image as another camera with white noise records it."""
    grain = noise_of(image.shape, seed)
    planes = (deviation * torch.ones_like(image), noise_of(image.shape, seed + 1))
    return Observation(image + deviation * grain, *planes, confidence * torch.ones_like(image))


def test_an_update_is_as_defined():
    y, x = torch.meshgrid(torch.arange(21.0), torch.arange(26.0), indexing="ij")
    clean = torch.randint(9, (1, 21, 26), generator=generator_for(6)) / 16  # exact sums, as above
    recorded = clean + torch.randint(3, clean.shape, generator=generator_for(7)) / 16
    grain = noise_of(clean.shape, 8)
    grain = grain + grain.roll(1, -1)
    seen = 0.9 * clean.roll(1, -1) + 0.1 + 0.03 * grain
    other = Observation(seen, (0.03 + 0.001 * x)[None], grain, (0.3 + 0.02 * y)[None])
    given = clean, recorded, (0.05 + 0.002 * y)[None], other
    torch.testing.assert_close(other_camera_update(*given), update_directly(*given), atol=1e-5, rtol=0)


@pytest.mark.parametrize(("deviation", "least", "most"), [(0.01, 0.2, 0.6), (0.1, 0.6, 0.95)])
def test_another_camera_takes_errors_away_the_more_the_less_its_noise(deviation, least, most):
    """From what Wiener's filter makes of a texture."""
    texture = noise_of((1, 1, 64, 80), 3)
    clean = 0.5 + 0.3 * avg_pool2d(pad(texture, (2, 2, 2, 2), mode="circular"), 5, 1)[0]
    sure = torch.full_like(clean, 0.1)
    recorded = clean + noise_of(clean.shape, 1, 0.1)
    estimate = wiener_filtered(recorded, clean, sure, clean)
    change = other_camera_update(estimate, recorded, sure, observed(clean, deviation=deviation))
    before, after = (float((x - clean).square().mean()) for x in (estimate, estimate + change))
    assert least < after / before < most


def test_what_another_camera_blurs_stays_sharp():
    """Its blur is found: stripes that it shows at half their contrast keep theirs."""
    clean = stripes(1, (64, 80))
    blurred = 0.5 + 0.5 * (clean - 0.5)
    sure = torch.full_like(clean, 0.1)
    assert float(other_camera_update(clean, clean, sure, observed(blurred)).abs().max()) < 0.01


@pytest.mark.parametrize("given", [{"confidence": 0.0}, {"deviation": 100.0}])
def test_what_another_camera_cannot_say_changes_nothing(given):
    clean = stripes(1)
    other = observed(clean.flip(-1), **given)
    change = other_camera_update(clean, clean, torch.full_like(clean, 0.1), other)
    assert float(change.abs().max()) < 1e-3


@pytest.mark.parametrize("hw", [(1, 1), (3, 50), (33, 40)])
def test_updates_of_any_size(hw):
    image = torch.rand(1, *hw, generator=generator_for(1))
    change = other_camera_update(image, image, torch.full_like(image, 0.1), observed(image, deviation=0.1))
    assert change.shape == image.shape
    assert bool(change.isfinite().all())
