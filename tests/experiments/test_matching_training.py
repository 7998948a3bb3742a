"""Training of features for matching: exact matches, a loss that wants them, runs that continue exactly."""

import json

import pytest
import torch
from safetensors.torch import load_file
from torch import Generator

from arraygeom import sample
from experiments.learned_matching.features import BITS, FeatureConfig, MatchingEncoder
from experiments.learned_matching.loss import (
    Queries,
    drawn_queries,
    matching_loss,
    scores,
    signs,
    unlike_bits,
    unlike_brightness,
)
from experiments.learned_matching.samples import (
    ColourPair,
    MatchingRecording,
    MatchingScenes,
    recorded_sample,
    window_of,
)
from experiments.learned_matching.training import FeatureTraining, command_line, train_features
from pat.data.pairs import Disparity, StereoPair
from pat.media.images import write_image
from pat.synthesis.photos import PhotoBank


def smooth(hw, seed, bands=3):
    small = torch.rand(1, bands, hw[0] // 8, hw[1] // 8, generator=Generator().manual_seed(seed))
    return torch.nn.functional.interpolate(small, hw, mode="bilinear")[0]


def bank():
    return PhotoBank([(smooth((96, 128), i) * 255).byte().movedim(0, -1).numpy() for i in range(3)])


def flat_pair(disparity=6.0):
    scene = smooth((64, 160), 5)
    known = Disparity(torch.full((64, 128), disparity), torch.ones(64, 128, dtype=torch.bool))
    left, right = scene[..., :128], scene[..., int(disparity) : 128 + int(disparity)]
    return StereoPair("flat", left, right, 20.0, known)


def unlike_at(given: ColourPair, shift=0.0):
    """The mean difference of alpha and beta at the true match, moved along the segment, where it is seen."""
    matches = given.matches
    where = matches.end + (matches.label + shift)[..., None] * matches.along
    found = sample(given.beta, where.flatten(1, 2).float()).values.view_as(given.alpha)
    return float((found - given.alpha).abs().mean(1)[matches.seen & matches.known].mean())


@pytest.mark.parametrize("number", range(6))
def test_views_of_layers_are_alike_at_their_true_matches(number):
    given = MatchingScenes(bank(), [], hw=(48, 64), batch=2, pairs=0.0, seed=1).made(number)
    assert unlike_at(given) < 0.6 * min(unlike_at(given, 2.0), unlike_at(given, -2.0))
    assert (given.matches.label <= given.matches.length + 0.5)[given.matches.seen].all()


@pytest.mark.parametrize("seed", range(8))
def test_windows_of_pairs_are_alike_however_they_are_mirrored(seed):
    given = window_of(flat_pair(), (32, 64), Generator().manual_seed(seed))
    assert unlike_at(given) < 1e-5 < 0.1 * unlike_at(given, 2.0)


def test_at_half_the_size_labels_are_half():
    matches = window_of(flat_pair(), (32, 64), Generator().manual_seed(0)).matches
    half = matches.halved()
    assert half.label.shape == (1, 16, 32)
    assert torch.allclose(half.label[half.known], torch.tensor(3.0))
    middle = (matches.end[:, ::2, ::2] + matches.end[:, 1::2, 1::2]) / 2
    assert torch.allclose(half.end, (middle + 0.5) / 2 - 0.5, atol=1e-4)


def test_at_half_the_size_edges_are_not_known():
    matches = window_of(flat_pair(), (32, 64), Generator().manual_seed(0)).matches
    matches.label[:, :, 31:] += 10
    known = matches.halved().known
    assert not known[:, :, 15].any()
    assert known[:, :, :15].all()


def test_views_are_recorded_differently_and_the_same_each_time():
    given = MatchingScenes(bank(), [], hw=(48, 64), batch=2, pairs=0.0, seed=1).made(0)
    draws = (Generator().manual_seed(n) for n in (4, 4, 5))
    first, again, other = (recorded_sample(given, g, MatchingRecording()) for g in draws)
    assert torch.equal(first.full[0], again.full[0])
    assert torch.equal(first.half[1], again.half[1])
    assert not torch.equal(first.full[1], other.full[1])


def only_query(label, seen=True):
    labels = torch.arange(8.0).expand(1, 1, 8)
    place = labels.long()
    there = torch.ones(1, 1, 8, dtype=torch.bool)
    return Queries(
        torch.zeros(1, 1, dtype=torch.long),
        torch.tensor([[label]]),
        torch.tensor([[seen]]),
        labels,
        place,
        there,
    )


def codes(*rows):
    return torch.stack(rows, 1)[None, :, None]


def loss_where(alpha, beta, query, unseen=16.0):
    return scores(unlike_bits(alpha, beta, query), query, torch.tensor(-1.0), torch.tensor(unseen))


def test_the_loss_wants_the_true_position():
    draw = torch.randn(8, BITS, generator=Generator().manual_seed(0))
    beta = codes(*draw)
    right, wrong = (loss_where(codes(*[draw[i]] * 8), beta, only_query(3.0)) for i in (3, 6))
    assert right.loss < 0.1 < 5 < wrong.loss
    assert right.within_one == 1
    assert wrong.within_one == 0


def test_the_loss_wants_what_is_not_seen_to_be_unlike_everything():
    draw = torch.randn(9, BITS, generator=Generator().manual_seed(0))
    beta = codes(*draw[:8])
    unlike, like = (loss_where(codes(*[draw[i]] * 8), beta, only_query(3.0, seen=False)) for i in (8, 3))
    assert unlike.loss < 0.5 < 3 < like.loss


def test_between_two_labels_both_are_right():
    same, other = torch.ones(BITS), -torch.ones(BITS)
    beta = codes(*[same if i in (3, 4) else other for i in range(8)])
    found = loss_where(codes(*[same] * 8), beta, only_query(3.5))
    assert torch.isclose(found.loss, torch.tensor(2.0).log(), atol=0.01)


def test_brightness_costs_what_it_costs_in_matching():
    alpha, beta = torch.full((1, 1, 1, 8), 0.5), torch.linspace(0.5, 1.9, 8)[None, None, None]
    found = unlike_brightness(alpha, beta, only_query(3.0))
    assert torch.allclose(found[0, 0], (30 * torch.linspace(0, 1.4, 8)).clamp(max=20))


def test_labels_that_are_drawn_include_the_true_one():
    given = MatchingScenes(bank(), [], hw=(48, 64), batch=2, pairs=0.0, seed=1).made(0)
    for window in ((24, 24), None):
        found = drawn_queries(given.matches, Generator().manual_seed(0), window)
        near = ((found.labels - found.label[..., None]).abs() <= 0.5 + 1e-4) & found.there
        assert near.any(-1)[found.seen].float().mean() > 0.99


def test_signs_have_the_gradient_of_tanh():
    x = torch.tensor([-0.5, 0.2, 2.0], requires_grad=True)
    found = signs(x)
    found.sum().backward()
    assert found.tolist() == [-1, 1, 1]
    assert torch.allclose(x.grad, 1 - x.detach().tanh() ** 2)


def test_the_encoder_learns_from_the_loss():
    torch.manual_seed(0)
    window = window_of(flat_pair(), (32, 96), Generator().manual_seed(1))
    given = recorded_sample(window, Generator().manual_seed(1), MatchingRecording())
    encoder = MatchingEncoder(FeatureConfig(8))
    adam = torch.optim.Adam(encoder.parameters(), lr=2e-3)
    losses = []
    for _ in range(30):
        adam.zero_grad()
        full, half = matching_loss(encoder, given, Generator().manual_seed(0))
        (full.loss + half.loss).backward()
        adam.step()
        losses.append(torch.stack([full.loss, half.loss]).detach())
    assert (losses[-1] < 0.95 * losses[0]).all()


def short(folder, **changes):
    for i in range(4):
        write_image(folder / "photos" / f"{i}.png", smooth((96, 128), i))
    given = {"photos": (folder / "photos",), "network": FeatureConfig(4), "steps": 4, "hw": (32, 48)}
    given |= {"out": folder / "run", "save": 2, "validate": 2, "held_out": 2, "pairs": 0.0}
    given |= {"precision": "float32"}
    return FeatureTraining(**given | changes)


@pytest.mark.slow  # failed once of three beside other work: the weights of one layer differed
def test_a_run_that_stopped_continues_exactly(tmp_path, monkeypatch):
    whole = load_file(train_features(short(tmp_path, out=tmp_path / "whole")))
    backward, done = torch.Tensor.backward, []

    def stopped(loss):
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(backward(loss))

    monkeypatch.setattr(torch.Tensor, "backward", stopped)
    with pytest.raises(KeyboardInterrupt):
        train_features(short(tmp_path))
    monkeypatch.undo()
    found = load_file(train_features(short(tmp_path)))
    assert {k: torch.equal(v, found[k]) for k, v in whole.items()} == dict.fromkeys(found, True)
    log = (tmp_path / "run" / "log.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in log] == [0, 2, 4]


def test_another_recipe_in_the_same_folder_is_refused(tmp_path):
    train_features(short(tmp_path, steps=2))
    with pytest.raises(ValueError, match="another --out"):
        train_features(short(tmp_path, steps=2, rate=1e-4))


def test_the_recipe_of_the_package_is_read():
    found = command_line(["features", "--seed", "3"])
    assert found.seed == 3
    assert found.aside
    with pytest.raises(FileNotFoundError, match="features"):
        command_line(["feature"])
