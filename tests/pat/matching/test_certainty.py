"""Certainty of matches: what it is read off, the same in pieces, any network's, and depth's interval."""

from dataclasses import replace

import pytest
import torch
from skimage.data import stereo_motorcycle

from experiments.evaluation.certainty import Reliability
from pat import fuse
from pat.app.sample_array import load_motorcycle, load_sample
from pat.fusion.frame import Frame
from pat.matching import certainty, choice
from pat.matching.choice import MEASURED, measured, typical_facts, with_certainty
from pat.matching.inputs import BetaMatches, Comparison, Matches
from pat.matching.match import match
from pat.matching.normalisation import Normalisation
from pat.networks.weights import load_weights


def a_match(facts, disparity=None, blurs=((0.6,), (0.0,))):
    """Matches of one image of 8 x 8 pixels with these facts everywhere."""
    planes = torch.tensor(facts)[None, :, None, None].expand(1, 3, 4, 4).clone()
    disparity = torch.full((1, 1, 8, 8), 5.0) if disparity is None else disparity
    normalisation = Normalisation(torch.zeros(3, 1, 1, 1, 1), tuple(map(list, blurs)))
    comparison = Comparison(None, normalisation, normalisation)
    stated = torch.tensor([2.0, -1.0])[None, :, None, None].expand(1, 2, 4, 4)
    return BetaMatches(disparity, planes, comparison, stated=stated)


def test_what_certainty_is_read_off():
    disparity = torch.full((1, 1, 8, 8), 5.0)
    disparity[..., 6:] = 9.0
    found = a_match([0.0, 0.5, 0.25], disparity)
    numbers = measured(found, typical_facts(found))[0]
    assert numbers.shape == (MEASURED, 4, 4)
    near, far = numbers[9, 0], numbers[10, 0]
    torch.testing.assert_close(near.exp() - 0.1, torch.tensor([0.0, 0.0, 4.0, 4.0]))
    torch.testing.assert_close(far.exp() - 0.1, torch.tensor([0.0, 4.0, 4.0, 4.0]))
    assert numbers[11:, 0, 0].tolist() == pytest.approx([0.6, 0.0, 0.5, 0.25, 2.0, -1.0])


def test_other_threads_find_the_networks_as_they_were():
    """Moved in place to float64, they broke matching in float32 beside."""
    sample = load_sample()
    rig = sample.rig.replace(
        cameras={name: sample.rig[name].crop(0, 0, (64, 96)) for name in sample.rig.names}
    )
    images = {name: image[:, :64, :96].double() for name, image in sample.images.items()}
    frame = fuse(images, rig, alpha="mono", network=load_weights("mono-colour").double())
    assert frame.image.dtype == torch.float64
    for network in (certainty.fitted_certainty(), choice.fitted_choice()):
        assert {weight.dtype for weight in network.parameters()} == {torch.float32}


def test_what_is_surely_hidden_keeps_a_little_certainty():
    """Its chosen disparity gives depth all the same."""
    found = a_match([1.0, 0.0, 1.0])
    found = replace(found, stated=torch.tensor([-60.0, 4.0])[None, :, None, None].expand(1, 2, 4, 4))
    (beta,) = with_certainty(Matches((found,))).betas
    torch.testing.assert_close(beta.certainty[:, 0], torch.full((1, 4, 4), certainty.SETTINGS.least))


def test_typical_facts_are_of_consistent_matches():
    found = a_match([0.0, 0.5, 0.25])
    found.facts[:, :, :, :2] = torch.tensor([1.0, 0.0, 1.0])[None, :, None, None]
    assert typical_facts(found).tolist() == [pytest.approx([0.5, 0.25])]


@pytest.fixture(scope="module")
def kept():
    """The sample's inputs with one colour beta, their matches, and the frame."""
    sample, found = load_sample(), []

    def matcher(inputs):
        found.append((inputs, match(inputs)))
        return found[-1][1]

    images = {name: sample.images[name] for name in ("mono", "colour")}
    frame = fuse(images, sample.rig, alpha="mono", network=load_weights("mono-colour"), matcher=matcher)
    return (*found[-1], frame, sample)


def test_pieces_are_as_certain_as_the_whole(kept, monkeypatch):
    _, found, *_ = kept
    monkeypatch.setattr(certainty, "ROWS", 32)
    assert found.hw[0] > 5 * 64
    again = with_certainty(found)
    torch.testing.assert_close(again.betas[0].certainty, found.betas[0].certainty, atol=1e-5, rtol=1e-4)


def test_matches_that_do_not_come_back_are_less_certain(kept):
    _, found, *_ = kept
    (beta,) = found.betas
    probability = beta.certainty[:, 0]
    assert probability.min() >= 0
    assert probability.max() <= 1
    back, not_back = (float(probability[p].mean()) for p in (beta.facts[:, 0] < 0.05, beta.facts[:, 0] > 0.9))
    assert back > 0.5
    assert not_back < 0.4 * back  # of some of these another disparity was chosen, which is right


def test_confidence_is_the_matches_whatever_the_network(kept):
    """The same for other weights: where matches lie is the same."""
    *_, frame, sample = kept
    images = {name: sample.images[name] for name in ("mono", "colour")}
    other = fuse(images, sample.rig, alpha="mono", network=load_weights("mono-colour"))
    assert (frame.confidence - other.confidence).abs().mean() < 1e-4


@pytest.fixture(scope="module")
def motorcycle():
    """The frame of a real pair, and its true depth, NaN where that is not known."""
    array = load_motorcycle()
    frame = fuse(array.images, array.rig, alpha="mono", network=load_weights("mono-colour"))
    disparity = torch.from_numpy(stereo_motorcycle()[2][:, :740].copy())
    pair = array.rig.pair("mono", "colour")
    baseline = float(pair.beta_from_alpha.t.norm())
    depth = 994.978 * baseline / (disparity + 31.086)
    return frame, torch.where(disparity.isfinite() & (disparity > 0), depth, torch.nan)


def test_true_depths_are_in_the_interval(motorcycle):
    """9 of 10, of a pair that it was not fitted to."""
    frame, depth = motorcycle
    near, far = frame.depth_interval
    known = depth.isfinite() & frame.depth.isfinite()
    inside = ((depth >= near) & (depth <= far))[known].float().mean()
    assert 0.85 < inside < 0.96


def test_confidence_is_the_share_of_depths_that_are_right(motorcycle):
    """Right means within a pixel of disparity; hidden points may be right by filling: a few more."""
    frame, depth = motorcycle
    known = depth.isfinite() & frame.depth.isfinite()
    pixel = 1 / (994.978 * 0.193001)
    right = ((1 / frame.depth - 1 / depth).abs() <= pixel)[known]
    found = Reliability.from_samples(frame.confidence[known], right)
    assert found.error < 0.08


def test_interval_is_of_the_pixels_that_it_says():
    """A focal length of 500 px and a baseline of .1 m: at 5 m disparity is 10 px, a pixel more is 4.545 m."""
    one = torch.ones(1, 1)
    near, far = Frame(torch.ones(1, 1, 1), 5 * one, one, 1 / 50 * one).depth_interval
    assert near.item() == pytest.approx(50 / 11)
    assert far.item() == pytest.approx(50 / 9)
    assert Frame(torch.ones(1, 1, 1), 5 * one, one, one).depth_interval[1].item() == torch.inf


def test_a_beta_that_was_doubted_alone_is_doubted_where_several_agree(kept):
    _, found, *_ = kept
    doubted = replace(found.betas[0], certainty=0.25 * found.betas[0].certainty)
    again = with_certainty(Matches((doubted,))).betas[0].certainty
    torch.testing.assert_close(again[:, 0], doubted.certainty[:, 0])
    torch.testing.assert_close(again[:, 1], found.betas[0].certainty[:, 1])
