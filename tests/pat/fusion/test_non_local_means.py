"""Means over pixels whose surroundings are alike."""

import pytest
import torch
from torch.nn.functional import pad

from pat.fusion.non_local_means import averaged_with_alike, sums_of_alike
from pat.media.colour import from_luma_chroma, luminance
from pat.sensors import generator_for


def noise_of(shape, seed, deviation=1.0):
    return deviation * torch.randn(shape, generator=generator_for(seed))


def two_colours(deviation=0.02):
    """Two colours of one luma beside each other: clean, and with noise of colour."""
    red = torch.where(torch.arange(64) < 32, 0.1, -0.1)
    chroma = torch.stack([red, -red])[:, None].expand(2, 48, 64)
    luma = 0.5 + 0.02 * torch.rand(1, 48, 64, generator=generator_for(0))
    return (
        from_luma_chroma(luma, chroma + noise_of(chroma.shape, s, d)) for s, d in ((1, 0.0), (1, deviation))
    )


def directly(guide, values, scale, reach):
    """The same sums as they are defined."""
    n = reach + 1
    g, v = (pad(t[None], (n,) * 4, mode="reflect")[0].double() for t in (guide, values))
    h, w = guide.shape[-2:]
    sums = torch.zeros(len(values), h, w).double()

    def at(t, y, x):
        return t[:, n + y : n + y + h, n + x : n + x + w]

    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            around = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1)]
            squares = [
                (at(g, y + dy, x + dx) - at(g, y, x)).square().mean(0, keepdim=True) for y, x in around
            ]
            sums += (-sum(squares) / 9 / scale**2).exp() * at(v, dy, dx)
    return sums


def means(sums):
    """The last band has the weights."""
    return (sums[:-1] / sums[-1:]).double()


@pytest.mark.parametrize(("hw", "reach"), [((37, 45), 4), ((40, 33), 6), ((5, 40), 3)])
def test_means_are_as_defined(hw, reach):
    guide, values = (0.5 + noise_of((3, *hw), s, 0.05) for s in (0, 1))
    values[2] = 1
    found, wanted = (f(guide, values, 0.1, reach) for f in (sums_of_alike, directly))
    torch.testing.assert_close(means(found), means(wanted), atol=2e-3, rtol=0)


def test_images_smaller_than_what_is_around_them_are_mirrored():
    sums = sums_of_alike(torch.full((1, 3, 1), 0.5), torch.full((1, 3, 1), 0.25), 0.1, 8)
    torch.testing.assert_close(sums, torch.full((1, 3, 1), 0.25 * 17**2))


def test_colour_noise_is_averaged_within_what_is_alike():
    """Noise of colour goes, the edge stays, and so does luma."""
    clean, noisy = two_colours()
    nothing = torch.zeros(1, 48, 64)
    quiet = averaged_with_alike(noisy, clean, nothing, 0.01)
    assert (quiet - clean).square().mean() < 0.1 * (noisy - clean).square().mean()
    torch.testing.assert_close(luminance(quiet), luminance(noisy))


def test_what_beta_recorded_counts_as_far_as_it_is_confident():
    """The fused colour is a little off: beta's noisy values, averaged, bring it back."""
    clean, _ = two_colours()
    off = from_luma_chroma(luminance(clean), 0.8 * (clean - luminance(clean))[[0, 2]])
    beta = clean + noise_of(clean.shape, 2, 0.05)

    def error(confidence):
        counts = torch.full((1, 48, 64), confidence)
        made = averaged_with_alike(off, beta, counts, 0.05)
        return float((made - clean).square().mean())

    assert error(1.0) < 0.3 * error(0.0)
