"""Colour completed by a network."""

import pytest
import torch

from pat.fusion.corrections import Corrections
from pat.matching.inputs import Inputs
from pat.matching.radiometry import fit
from pat.media.colour import luminance
from pat.networks.completion import CANDIDATES, SETTINGS, Completion
from pat.networks.guided import BetaEstimate, Encoded, GuidedPAT
from pat.networks.weights import load_weights


def drawn(bands, seed=0):
    return torch.rand(1, bands, 48, 64, generator=torch.Generator().manual_seed(seed))


def given(confidence):
    """Alpha, one confidence everywhere, an image of no luminance, and candidates: the first is the image."""
    mixed = drawn(3) - luminance(drawn(3))
    others = [mixed + 0.1 * (drawn(3, i) - luminance(drawn(3, i))) for i in range(1, CANDIDATES)]
    return drawn(1), torch.full((1, 1, 48, 64), confidence), mixed, (mixed, *others)


@pytest.fixture(scope="module")
def shipped():
    return load_weights("mono-colour").completion


def test_what_is_certain_stays(shipped):
    alpha, confidence, mixed, candidates = given(1.0)
    torch.testing.assert_close(shipped(alpha, confidence, mixed, candidates), mixed, atol=1e-6, rtol=0)


def test_what_is_doubtful_changes_and_luminance_stays(shipped):
    alpha, confidence, mixed, candidates = given(0.1)
    completed = shipped(alpha, confidence, mixed, candidates)
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


def test_bands_of_several_betas_are_not_completed(shipped, monkeypatch):
    """It was trained on one certainty of all bands."""
    monkeypatch.setattr(Completion, "forward", lambda *_: pytest.fail("completed"))
    network = load_weights("mono-colour")
    monkeypatch.setattr(network, "_fills", lambda own, alpha, e: (e.colour,) * (CANDIDATES - 1))
    plane = drawn(1)
    estimate = BetaEstimate(*[plane] * len(BetaEstimate._fields))
    assert network.blended(Encoded(plane, plane), plane, [estimate] * 3, complete=True).shape == (
        1,
        3,
        48,
        64,
    )
    network.blended(Encoded(plane, plane), plane, [estimate], complete=False)  # alpha sees something else


@pytest.mark.parametrize("alike", [True, False])
def test_colours_are_completed_if_alpha_sees_luma(alike):
    """Not an alpha in the near infrared, whose pixels say little of colours: training had none."""
    g = torch.Generator().manual_seed(0)
    bands = torch.rand(3, 4000, generator=g) * 0.8 + 0.1
    alpha = luminance(bands[..., None])[0, :, 0] if alike else torch.rand(4000, generator=g) * 0.8 + 0.1
    corrections = Corrections(fit(bands, alpha))
    assert corrections.applied(Inputs(drawn(1), ()), (48, 64)).sees_luma == alike
    assert corrections.response.is_rec601


def test_a_network_may_be_without(shipped):
    assert load_weights("mono-colour").completion is None
    assert GuidedPAT().working_bytes(10**6, [10**6]) < load_weights("mono-colour").working_bytes(
        10**6, [10**6]
    )
