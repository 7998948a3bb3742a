"""The choice between disparities and its confidence: candidates, features, scores, depth's interval."""

import math
from dataclasses import replace

import pytest
import torch
from skimage.data import stereo_motorcycle
from torch.nn.functional import grid_sample

from arraygeom import Rectified, Segments, pixel_grid
from arraygeom.fields.default import default_field
from arraygeom.fields.grid import FieldOnGrid
from experiments.evaluation.certainty import Reliability
from pat import fuse
from pat.app.sample_array import load_motorcycle, load_sample
from pat.fusion.frame import Frame
from pat.lab.evaluation.protocols import rectified_rig
from pat.matching import choice
from pat.matching import inputs as parts
from pat.matching.choice import (
    AROUND,
    CANDIDATES,
    MEASURED,
    Choice,
    candidates,
    chosen,
    features,
    measured,
    quarter_turns,
    typical_facts,
    with_certainty,
)
from pat.matching.inputs import BetaMatches, Comparison, Inputs, Matches
from pat.matching.match import located_in_one, match
from pat.matching.normalisation import ComparedViews, Normalisation
from pat.networks.weights import load_weights


def matches_of(disparity, unlike):
    """Matches of these disparities (h, w), matching back from beta disagrees as told (h / 2, w / 2)."""
    level = Normalisation(torch.zeros(3, 1, 1, 1, 1), ([0.6], [0.0]))
    facts = torch.stack([unlike, 0 * unlike + 0.5, 0 * unlike + 0.25])[None]
    return BetaMatches(disparity[None, None], facts, Comparison(None, level, level))


def test_candidates_are_the_nearest_consistent_ones_and_those_around():
    disparity = torch.arange(24.0 * 32).view(24, 32)
    unlike = torch.ones(12, 16)
    unlike[6, 8] = 0.0  # pixels 12, 13 of rows and 16, 17 of columns
    found = candidates(matches_of(disparity, unlike))[0]
    assert found.shape == (CANDIDATES, 24, 32)
    assert torch.equal(found[0], disparity)
    above, below, left, right = found[1:5]
    assert above[20, 16] == disparity[13, 16]
    assert below[3, 17] == disparity[12, 17]
    assert left[12, 30] == disparity[12, 17]
    assert right[13, 2] == disparity[13, 16]
    assert above[3, 16] == disparity[3, 16]
    assert left[5, 30] == disparity[5, 30]
    for (y, x), plane in zip(AROUND, found[5:]):
        assert plane[12, 14] == disparity[12 + y, 14 + x]
    assert found[5 + AROUND.index((0, 10)), 4, 30] == disparity[4, 31]


def test_what_scores_are_by():
    """Alpha and beta at each candidate, along segments that are no rows; out of beta its edge."""
    g = torch.Generator().manual_seed(0)
    h, w = 24, 32
    own, other = torch.rand(1, 1, h, w, generator=g), torch.rand(1, 1, 30, 40, generator=g)
    end = pixel_grid((h, w))[None] + torch.tensor([5.0, 2.0])
    segments = Segments(end + torch.tensor([-6.0, 8.0]), end, torch.ones(1, h, w, dtype=torch.bool))
    found = matches_of(8 * torch.rand(h, w, generator=g), torch.zeros(h // 2, w // 2))
    options = candidates(found)
    given = features(ComparedViews(own, other, None, [0.6]), segments, found, options, typical_facts(found))
    assert given.shape == (1, choice.FACTS + 4 * (1 + 2 * CANDIDATES), h // 2, w // 2)
    assert (given[0, :7, 3, 4] + 0.4).tolist() == pytest.approx(
        [0, 0.5, 0.25, 0.5, 0.25, 0.6 / choice.SETTINGS.blur, 0]
    )
    planes = torch.nn.functional.pixel_shuffle(given[:, 7:], 2)[0]
    torch.testing.assert_close(planes[0], own[0, 0] - 0.5)
    apart = (options[0, 1:] - options[0, :1]) / 6
    torch.testing.assert_close(planes[1:CANDIDATES], apart / (1 + apart.abs()), atol=1e-5, rtol=0)
    there = end + options[0, ..., None] * torch.tensor([-0.6, 0.8])
    grid = 2 * there / torch.tensor([39.0, 29.0]) - 1
    seen = grid_sample(other.expand(CANDIDATES, -1, -1, -1), grid, padding_mode="border", align_corners=True)
    unlike = 6 * (own[0] - seen[:, 0])
    torch.testing.assert_close(
        planes[CANDIDATES : 2 * CANDIDATES], unlike / (1 + unlike.abs()), atol=1e-4, rtol=0
    )
    x, y = there[0].unbind(-1)
    on = (x >= -0.5) & (x <= 39.5) & (y >= -0.5) & (y <= 29.5)
    assert torch.equal(planes[-1] > 0, on)
    assert 0 < float(on.float().mean()) < 1


@pytest.fixture(scope="module")
def motorcycle():
    """Inputs and matches of a real pair before anything is chosen."""
    array, found = load_motorcycle(), []

    def matcher(inputs):
        found.append((inputs, Matches((located_in_one(inputs),))))
        return match(inputs)

    fuse(array.images, array.rig, alpha="mono", network=load_weights("mono-colour"), matcher=matcher)
    return found[0]


def test_what_is_chosen_is_nearer_the_truth(motorcycle):
    """On a pair outside the training set fewer pixels are wrong by more than a pixel, and by more
    than three."""
    inputs, before = motorcycle
    (after,) = chosen(inputs, before).betas
    truth = torch.from_numpy(stereo_motorcycle()[2][:, :740].copy())
    known = truth.isfinite() & (truth > 0)
    segments = inputs.betas[0].field.straight
    h, w = truth.shape
    end = segments.end[0, :h, :w, 0].float()
    true = end - (torch.arange(w) - truth)

    def wrong(disparity, pixels):
        return float(((disparity[0, 0, :h, :w] - true).abs() > pixels)[known].float().mean())

    assert wrong(after.disparity, 1) < 0.5
    assert wrong(after.chosen, 1) < 0.95 * wrong(after.disparity, 1)
    assert wrong(after.chosen, 3) < 0.95 * wrong(after.disparity, 3)


def test_depth_is_of_what_was_chosen_and_colour_of_the_match():
    array = load_motorcycle()

    def farther(inputs):
        (found,) = match(inputs).betas
        return Matches((replace(found, chosen=found.chosen + 4),))

    one, other = (
        fuse(array.images, array.rig, alpha="mono", network=load_weights("mono-colour"), matcher=matcher)
        for matcher in (match, farther)
    )
    pixel = 1 / (994.978 * 0.193001)
    nearer = ((1 / other.depth - 1 / one.depth) / pixel).nanmedian()
    assert float(nearer) == pytest.approx(4, abs=0.2)
    assert torch.equal(other.image, one.image)


def test_pieces_choose_as_the_whole(motorcycle, monkeypatch):
    inputs, before = motorcycle
    (whole,) = chosen(inputs, before).betas
    monkeypatch.setattr(parts, "SETTINGS", replace(parts.SETTINGS, at_once=160_000))
    assert len(inputs.pieces) > 1
    (pieces,) = chosen(inputs, before).betas
    apart = (pieces.chosen - whole.chosen).abs()  # the nearest consistent pixel may be in another piece
    assert float((apart > 1).float().mean()) < 0.02
    seen, also = (found.stated[:, 0].sigmoid() for found in (pieces, whole))
    assert float((seen - also).abs().mean()) < 0.01


def turned(inputs, k):
    """The motorcycle's inputs, as recorded by cameras that both are turned."""
    rig, (beta,) = load_motorcycle().rig, inputs.betas
    for name, image in (("mono", inputs.alpha), ("colour", beta.image)):
        hw = image.shape[-2:]
        rig = rig.with_camera(name, rig[name].resize((500, 740)).replace(hw=hw)).rot90(name, k)
    alpha, other = (image.rot90(k, (-2, -1)) for image in (inputs.alpha, beta.image))
    pair = rig.pair("mono", "colour")
    field = FieldOnGrid.from_field(default_field(pair), pair, hw=alpha.shape[-2:], blocks=True)
    return replace(inputs, alpha=alpha, betas=(replace(beta, image=other, field=field, clipped=None),))


def test_quarter_turns_bring_near_ends_to_the_left():
    towards = torch.tensor([[-1, 0], [0, -1], [1, 0], [0, 1], [-0.8, 0.6], [0, 0]])[None, None]
    segments = Segments(towards, torch.zeros_like(towards), torch.ones(1, 1, 6, dtype=torch.bool))
    assert quarter_turns(segments).tolist() == [[[0, 1, 2, 3, 0, 0]]]


@pytest.mark.parametrize("k", [1, 2, 3])
def test_beta_may_be_on_any_side(motorcycle, k):
    """The network knows beta on the right: turned views have the choices and statements of upright ones."""
    inputs, (found,) = motorcycle[0], motorcycle[1].betas
    (upright,) = chosen(turned(inputs, 0), Matches((found,))).betas
    planes = {n: getattr(found, n).rot90(k, (-2, -1)) for n in ("disparity", "facts")}
    (sideways,) = chosen(turned(inputs, k), Matches((replace(found, **planes),))).betas
    apart = (sideways.chosen.rot90(-k, (-2, -1)) - upright.chosen).abs()
    assert float((apart > 0.01).float().mean()) < 0.001
    torch.testing.assert_close(sideways.stated.rot90(-k, (-2, -1)), upright.stated, atol=0.02, rtol=0)


def test_what_is_known_of_a_pixel_stays_its_own(motorcycle):
    inputs, before = motorcycle
    around = replace(inputs, betas=(replace(inputs.betas[0], around=True),))
    (found,) = chosen(around, before).betas
    assert found.surface is before.betas[0].disparity
    assert found.stated is not None


def test_sides_need_not_be_multiples():
    """A network that wants the candidate five columns to the right."""
    want = 5 + AROUND.index((0, 5))

    class Wanting(Choice):
        def forward(self, given):
            b, _, h, w = given.shape
            scores = torch.zeros(b, CANDIDATES + 2, 4, h, w)
            scores[:, want] = 1.0
            return scores

    h, w = 22, 34
    disparity = torch.arange(float(h * w)).view(h, w)
    found = matches_of(disparity, torch.zeros(h // 2, w // 2))
    g = torch.Generator().manual_seed(1)
    rig = rectified_rig((h, w), {"beta": (h, w)}, 30.0)
    field = FieldOnGrid.from_field(
        Rectified(30.0, alpha_is="left"), rig.pair("alpha", "beta"), hw=(h, w), blocks=True
    )
    inputs = Inputs.from_images(
        torch.rand(1, 1, h, w, generator=g), [torch.rand(1, 3, h, w, generator=g)], [field]
    )
    followed = replace(found, disparity=found.disparity.requires_grad_())
    made = chosen(inputs, Matches((followed,)), Wanting()).betas[0].chosen[0, 0]
    assert not made.requires_grad
    assert torch.equal(made[:, :-5], disparity[:, 5:])
    assert math.isfinite(float(made.sum()))


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
    for network in (choice.fitted_certainty(), choice.fitted_choice()):
        assert {weight.dtype for weight in network.parameters()} == {torch.float32}


def test_what_is_surely_hidden_keeps_a_little_certainty():
    """Its chosen disparity gives depth all the same."""
    found = a_match([1.0, 0.0, 1.0])
    found = replace(found, stated=torch.tensor([-60.0, 4.0])[None, :, None, None].expand(1, 2, 4, 4))
    (beta,) = with_certainty(Matches((found,))).betas
    torch.testing.assert_close(beta.certainty[:, 0], torch.full((1, 4, 4), choice.SETTINGS.least))


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
    monkeypatch.setattr(choice, "ROWS", 32)
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
def fused_motorcycle():
    """The frame of a real pair, and its true depth, NaN where that is not known."""
    array = load_motorcycle()
    frame = fuse(array.images, array.rig, alpha="mono", network=load_weights("mono-colour"))
    disparity = torch.from_numpy(stereo_motorcycle()[2][:, :740].copy())
    pair = array.rig.pair("mono", "colour")
    baseline = float(pair.beta_from_alpha.t.norm())
    depth = 994.978 * baseline / (disparity + 31.086)
    return frame, torch.where(disparity.isfinite() & (disparity > 0), depth, torch.nan)


def test_true_depths_are_in_the_interval(fused_motorcycle):
    """9 of 10, of a pair that it was not fitted to."""
    frame, depth = fused_motorcycle
    near, far = frame.depth_interval
    known = depth.isfinite() & frame.depth.isfinite()
    inside = ((depth >= near) & (depth <= far))[known].float().mean()
    assert 0.85 < inside < 0.96


def test_confidence_is_the_share_of_depths_that_are_right(fused_motorcycle):
    """Right means within a pixel of disparity; hidden points may be right by filling: a few more."""
    frame, depth = fused_motorcycle
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
