"""Training: samples that agree with their geometry, a loss that goes down, a file that loads."""

from dataclasses import replace

import pytest
import torch
from torch import Generator

from arraygeom import Epipolar, Segments, sample
from pat.lab.training.losses import Objective, image_loss
from pat.lab.training.samples import degraded, scenes
from pat.media.colour import luminance
from pat.networks.weights import new_network

from .runs import short_run


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return short_run(tmp_path_factory.mktemp("photos"))


def test_ground_truth_is_where_the_geometry_says(config):
    """Beta looked up at the true positions is alpha's view in colour, wherever beta sees the surface."""
    learn, _ = scenes(config)
    errors = []
    for given in learn(6):
        found = sample(given.betas[0], given.position[0]).values
        off = (found - given.ground_truth).abs().mean(1)
        errors.append(off[given.visible[0]].median())
        assert (luminance(given.ground_truth) - given.alpha).abs().max() < 1e-5
    assert torch.stack(errors).median() < 0.05


def test_positions_lie_on_the_segments(config):
    learn, _ = scenes(config)
    for given in learn(3):
        for field, position, visible in zip(given.fields, given.position, given.visible):
            h, w = visible.shape[1:]
            x = (
                torch.stack(torch.meshgrid(torch.arange(w), torch.arange(h), indexing="xy"), -1)
                .float()
                .reshape(-1, 2)
            )
            segments = field.at(x)
            nearest = segments.at(segments.fraction(position.reshape(len(position), -1, 2)).clamp(0, 1))
            off = (nearest - position.reshape(len(position), -1, 2)).norm(dim=-1)
            assert off[segments.valid & visible.reshape(len(visible), -1)].max() < 0.1


def near_half(pair, x):
    found = Epipolar()(pair, x)
    return Segments(found.start, found.at(torch.full_like(found.start[..., 0], 0.5)), found.valid)


def test_a_field_of_ones_own_trains(config):
    """A field in a few lines, which a recipe names, is where the samples look."""
    learn, _ = scenes(replace(config, field=f"{__name__}:near_half"))
    whole, _ = scenes(config)
    x = torch.tensor([[20.0, 15.0]])
    (mine, all_of_it) = (next(source(1)).fields[0].at(x) for source in (learn, whole))
    assert torch.allclose(2 * mine.length, all_of_it.length, rtol=1e-4)


def test_the_same_seed_makes_the_same_samples(config):
    first, second = (next(scenes(config)[0](1)) for _ in range(2))
    assert torch.equal(first.alpha, second.alpha)
    assert torch.equal(first.betas[0], second.betas[0])


def test_every_sample_pulls_alike():
    ground_truth = torch.zeros(1, 3, 4, 4)
    assert float(image_loss(ground_truth + 0.1, ground_truth)) == pytest.approx(-2, abs=1e-3)
    assert float(image_loss(ground_truth + 1.0, ground_truth)) == pytest.approx(0, abs=1e-3)


def test_degradation_keeps_the_ground_truth_in_colour(config):
    from pat.lab.synthesis.layered import LayeredScenes
    from pat.lab.synthesis.rig_distribution import RigDistribution
    from pat.lab.training.samples import photographs

    scene = LayeredScenes(photographs(config)[0], RigDistribution(), hw=(32, 48)).sample(
        2, Generator().manual_seed(1)
    )
    given = degraded(scene, Generator().manual_seed(2))
    ideal = scene.images[0]
    assert (
        given.ground_truth - luminance(given.ground_truth) - (ideal - luminance(ideal))
    ).abs().max() < 1e-5


def test_three_betas_have_a_band_each(config):
    """There are as many cameras as the network is made for, at places of their own."""
    three = replace(config, network=replace(config.network, betas=3, in_channels=1))
    for given in scenes(three)[0](4):
        assert [beta.shape[1] for beta in given.betas] == [1, 1, 1]
        found = torch.cat([sample(b, x).values for b, x in zip(given.betas, given.position)], 1)
        seen = torch.stack(given.visible).all(0)
        assert (found - given.ground_truth).abs().mean(1)[seen].median() < 0.08
        assert torch.isfinite(Objective(new_network(three.network), "psnr", attention=1.0)(given))
