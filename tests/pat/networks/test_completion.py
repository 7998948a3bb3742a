"""Colour completed by a network."""

import pytest
import torch

from pat.fusion.corrections import Corrections
from pat.matching.inputs import Inputs
from pat.matching.radiometry import fit
from pat.media.colour import luminance
from pat.networks.completion import CANDIDATES, SETTINGS, Completion


def drawn(bands, seed=0):
    return torch.rand(1, bands, 48, 64, generator=torch.Generator().manual_seed(seed))


def given(confidence):
    """Alpha, one confidence everywhere, an image of no luminance, and candidates: the first is the image."""
    mixed = drawn(3) - luminance(drawn(3))
    others = [mixed + 0.1 * (drawn(3, i) - luminance(drawn(3, i))) for i in range(1, CANDIDATES)]
    return drawn(1), torch.full((1, 1, 48, 64), confidence), mixed, (mixed, *others)


@pytest.fixture(scope="module")
def network():
    """With random weights."""
    torch.manual_seed(0)
    made = Completion((4, 4, 4))
    torch.nn.init.normal_(made.unet.last.weight, std=0.3)
    return made.requires_grad_(False)


def test_what_is_certain_stays(network):
    """Of the candidates the matched one is the image there."""
    alpha, confidence, mixed, candidates = given(1.0)
    torch.testing.assert_close(network(alpha, confidence, mixed, candidates), mixed, atol=1e-6, rtol=0)


def test_what_is_doubtful_changes_and_luminance_stays(network):
    alpha, confidence, mixed, candidates = given(0.1)
    completed = network(alpha, confidence, mixed, candidates)
    assert float((completed - mixed).abs().mean()) > 1e-3
    torch.testing.assert_close(luminance(completed), luminance(mixed), atol=1e-5, rtol=0)


def test_before_training_the_image_stays_mostly():
    alpha, confidence, mixed, candidates = given(0.0)
    completed = Completion((4, 4, 4))(alpha, confidence, mixed, candidates)
    share = SETTINGS.strength / (CANDIDATES + torch.tensor(3.0).exp())
    torch.testing.assert_close(completed, mixed + share * sum(c - mixed for c in candidates))


def test_a_candidate_that_is_chosen_is_taken_as_far_as_is_set():
    network, (alpha, confidence, mixed, candidates) = Completion((4, 4, 4)), given(0.0)
    with torch.no_grad():
        network.unet.last.bias.view(-1, 4)[2 + 3] = (
            50.0  # own chroma, then the image, then the third candidate
        )
    completed = network(alpha, confidence, mixed, candidates)
    torch.testing.assert_close(completed, torch.lerp(mixed, candidates[2], SETTINGS.strength))


@pytest.mark.parametrize("alike", [True, False])
def test_colours_are_completed_if_alpha_sees_luma(alike):
    """Not an alpha in the near infrared, whose pixels say little of colours: training had none."""
    g = torch.Generator().manual_seed(0)
    bands = torch.rand(3, 4000, generator=g) * 0.8 + 0.1
    alpha = luminance(bands[..., None])[0, :, 0] if alike else torch.rand(4000, generator=g) * 0.8 + 0.1
    corrections = Corrections(fit(bands, alpha))
    assert corrections.applied(Inputs(drawn(1), ()), (48, 64)).sees_luma == alike
    assert corrections.response.is_rec601
