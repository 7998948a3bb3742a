"""Groups of alike blocks, filtered together."""

import numpy as np
import pytest
import torch
from scipy.fft import dctn, idctn
from scipy.linalg import hadamard

from arraygeom.threads import limited_to
from pat.networks.bm3d import ALIKE, RADIUS, SIDE, STEP, WINDOW, refined, wiener_filtered
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


def directly(image, expected, guide, deviation):
    """The same as it is defined, block by block."""
    n, (h, w) = RADIUS + SIDE, image.shape[1:]
    margins = [(0, 0), (n, n + SIDE), (n, n + SIDE)]
    seen, known, alike, noise = (
        np.pad(t.double().numpy(), margins, mode="symmetric")
        for t in (image, expected, guide, deviation.square())
    )
    total, weights = np.zeros_like(seen), np.zeros_like(seen)
    for y in range(n - SIDE + STEP, n + h, STEP):
        for x in range(n - SIDE + STEP, n + w, STEP):
            places = [(y + i, x + j) for i in range(-RADIUS, RADIUS + 1) for j in range(-RADIUS, RADIUS + 1)]
            own = alike[:, y : y + SIDE, x : x + SIDE]
            places.sort(key=lambda p: ((alike[:, p[0] : p[0] + SIDE, p[1] : p[1] + SIDE] - own) ** 2).sum())
            places = places[:ALIKE]
            for c in range(len(image)):
                blocks, model = (
                    to_groups(np.stack([t[c, i : i + SIDE, j : j + SIDE] for i, j in places]))
                    for t in (seen, known)
                )
                variance = np.mean([noise[c, i + 4, j + 4] for i, j in places])
                share = model**2 / (model**2 + variance)
                blocks = idctn(
                    np.einsum("nm,mij->nij", HADAMARD.T, blocks * share), axes=(1, 2), norm="ortho"
                )
                weight = WINDOW / (variance + 1e-8) / (1 + np.square(1.0 * share).sum())
                for (i, j), block in zip(places, blocks):
                    total[c, i : i + SIDE, j : j + SIDE] += weight * block
                    weights[c, i : i + SIDE, j : j + SIDE] += weight
    inside = np.s_[:, n : n + h, n : n + w]
    return torch.from_numpy(total[inside] / weights[inside]).float()


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
