"""Random bands: what they are made of, and samples of them."""

from dataclasses import replace

import torch
from torch import Generator

from arraygeom import sample
from pat.lab.training.lenses import Spectra
from pat.lab.training.losses import Objective
from pat.lab.training.samples import scenes
from pat.media.colour import luminance
from pat.networks.configs import BandwisePATConfig
from pat.networks.weights import new_network

from .runs import short_run


def test_bands_are_mixtures_with_gamma_and_contrast():
    spectra = Spectra.drawn(2, 5, Generator().manual_seed(0))
    image = torch.rand(2, 3, 6, 7)
    bands = spectra.of(image)
    for b in range(2):
        for c in range(5):
            mixed = sum(float(spectra.mixture[b, c, k]) * image[b, k] for k in range(3))
            low, high = spectra.low[b, c], spectra.high[b, c]
            assert torch.allclose(bands[b, c], low + (high - low) * mixed ** spectra.gamma[b, c], atol=1e-6)
    assert bands.min() >= 0
    assert bands.max() <= 1


def test_some_are_inverted_and_some_of_one_colour():
    spectra = Spectra.drawn(300, 4, Generator().manual_seed(0))
    assert 0.05 < (spectra.low > spectra.high).float().mean() < 0.15
    assert 0.4 < (spectra.mixture.amax(-1) == 1).float().mean() < 0.6


def test_samples_have_random_bands_in_ground_truth_and_beta_alike(tmp_path):
    config = short_run(tmp_path)
    config = replace(
        config, recording=replace(config.recording, spectral=1.0, paper=0.0, ideal=True, noise=0.0)
    )
    counts = set()
    for given in scenes(replace(config, filtered=0.3))[0](12):
        counts.add(tuple(beta.shape[1] for beta in given.betas))
        assert given.ground_truth.shape[1] == sum(beta.shape[1] for beta in given.betas)
        assert given.alpha.shape[1] == 1
        found = torch.cat([sample(b, x).values for b, x in zip(given.betas, given.position)], 1)
        seen = torch.stack(given.visible).all(0)
        assert (found - given.ground_truth).abs().mean(1)[seen].median() < 0.08
    assert (1, 1, 1) in counts
    assert len(counts) > 2


def test_without_them_samples_are_as_they_were(tmp_path):
    given = next(scenes(replace(short_run(tmp_path), filtered=0.0))[0](1))
    assert given.ground_truth.shape[1] == 3
    assert (luminance(given.ground_truth) - given.alpha).abs().max() < 1e-5


def test_a_network_of_any_bands_learns_from_them(tmp_path):
    config = short_run(tmp_path)
    config = replace(
        config,
        network=BandwisePATConfig(widths=(8, 8, 8, 8), taps=5),
        recording=replace(config.recording, spectral=1.0, paper=0.0, ideal=True),
    )
    network = new_network(config.network)
    objective = Objective(network, config.loss)
    for given in scenes(config)[0](3):
        loss = objective(given)
        loss.backward()
        assert torch.isfinite(loss)
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in network.parameters())
