"""Training data of the choice between disparities: true positions, and a step of training."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from safetensors import safe_open
from torch.nn.functional import max_pool2d

from experiments.choice import ChoiceTraining, Kept, losses, rows_of, train_choice, window
from experiments.evaluation.certainty import unseeing
from experiments.fit import command
from experiments.training_pairs import samples
from experiments.training_pairs.pairs import HW, photo_pair, varied_pair
from experiments.training_pairs.shapes import seen_from_right, shape_pair
from pat.lab.data.pairs import Disparity, StereoPair
from pat.matching.choice import CANDIDATES, FACTS, Choice
from pat.support.tensor_files import with_weights, write_tensors


def warped(pair):
    """Return right's values at left's pixels moved by the true disparity, with a mask of those on it."""
    h, w = pair.left.shape[1:]
    x = torch.arange(w) - pair.disparity.value
    there = x.round().long().clamp(0, w - 1).expand(3, h, w)
    return pair.right.gather(2, there), (x >= 0) & pair.disparity.valid


def test_photographs_pairs_have_the_disparity_they_were_made_with(photos):
    pair = photo_pair(photos / "astronaut.png", photos / "coffee.png", 3)
    assert pair.left.shape == pair.right.shape == (3, *HW)
    seen, on = warped(pair)
    apart, unmoved = ((image - pair.left).abs().amax(0) for image in (seen, pair.right))
    assert float((apart < 0.1)[on].float().mean()) > 0.75
    assert float((unmoved < 0.06).float().mean()) < 0.5
    assert pair.disparity.value.min() > 0


def stepped(unknown=0):
    """A pair of two surfaces, 12 and 20 px off, whose images say nothing; beside a step nothing is known."""
    value = torch.full(HW, 12.0)
    value[100:220, 200:300] = 20.0
    valid = torch.ones(HW) > 0
    valid[:, 200 - unknown : 200] = False
    grey = torch.full((3, *HW), 0.5)
    return StereoPair("a", grey, grey, 30.0, Disparity(value, valid))


def test_shapes_in_other_textures_have_the_disparity_they_were_made_with(photos):
    """Surfaces are whole, with one step between them: right shows left's pixels moved by what is stated."""
    files = sorted(photos.iterdir())
    for seed in range(4):
        pair = shape_pair(stepped(unknown=9), files, seed)
        seen, on = warped(pair)
        apart = (seen - pair.left).abs().amax(0)
        inside = on & (max_pool2d(pair.disparity.value[None], 5, 1, 2)[0] - pair.disparity.value < 0.5)
        assert float((apart[inside] > 0.1).float().mean()) < 0.02
        across = pair.disparity.value.diff(dim=1).abs()
        assert 0 < float((across > 0.5).float().mean()) < 2 / HW[1]
        assert pair.disparity.value.min() >= 2
        assert pair.disparity.value.max() <= 80
        assert torch.equal(pair.right, shape_pair(stepped(unknown=9), files, seed).right)
    with pytest.raises(ValueError, match="a: "):
        shape_pair(StereoPair("a", pair.left, pair.left, 30.0, None), files, 0)


def test_the_nearest_surface_is_seen_and_photographs_where_none_is():
    which = np.zeros(HW, int)
    which[100:220, 200:300] = 1
    disparity = np.stack([np.full(HW, n, np.float32) for n in (12, 20)])
    textures = np.stack([np.full((*HW, 3), n, np.float32) for n in (0.2, 0.8)])
    wanted = np.full((*HW, 3), 0.2, np.float32)
    wanted[100:220, 180:280] = 0.8
    wanted[:, HW[1] - 12 :] = wanted[100:220, 280:288] = 0.5  # beyond what left sees, and behind the near one
    hidden = np.full((*HW, 3), 0.5, np.float32)
    np.testing.assert_allclose(
        seen_from_right(which, disparity, textures, hidden), wanted, atol=0.08
    )  # a quarter of a pixel


def test_varied_pairs_are_of_the_same_scene():
    """Another size scales disparity, and both images have the same other colours."""
    g = torch.Generator().manual_seed(0)
    left = torch.nn.functional.interpolate(torch.rand(1, 3, 40, 56, generator=g), HW, mode="bicubic")[0]
    left = left.clamp(0, 1)
    pair = StereoPair("a", left, left.roll(-8, -1), 20.0, Disparity(torch.full(HW, 8.0), torch.ones(HW) > 0))
    for seed in range(4):
        made = varied_pair(pair, seed)
        size = made.left.shape[-1] / HW[1]
        torch.testing.assert_close(made.disparity.value.mean(), torch.tensor(8 * size))
        assert made.max_disparity > 8 * size
        seen, on = warped(made)
        on[:, :20] = False
        assert float((seen - made.left).abs()[:, on].mean()) < 0.02
        assert seed == 0 or float((made.left.mean((1, 2)) - left.mean((1, 2))).abs().max()) > 0.01


def kept(h=64, w=96):
    """A pair whose matches are right but in a square, which a neighbour's would be right for."""
    g = torch.Generator().manual_seed(1)
    truth = torch.full((1, h, w), 7.0)
    disparity = truth.clone()
    disparity[:, 20:24, 60:64] = 15.0
    facts, seen = torch.zeros(3, h // 2, w // 2), torch.ones(1, h, w) > 0
    alpha = torch.rand(1, h, w, generator=g)
    return Kept(alpha, alpha.roll(-7, -1), disparity, facts, truth, seen, torch.zeros(2))


def test_a_window_has_the_true_position_among_its_candidates():
    given, options, truth, seen = window(kept(), 64, torch.Generator().manual_seed(0))
    assert given.shape == (1, FACTS + 4 * (1 + 2 * CANDIDATES), 32, 32)
    assert options.shape == (1, CANDIDATES, 64, 64)
    assert bool(((options - truth).abs() < 0.1).any(1).all())
    assert bool(seen.all())


def test_upside_down_all_planes_are():
    one = kept()
    found = one.upside_down()
    assert torch.equal(found.disparity[:, 40:44, 60:64], torch.full((1, 4, 4), 15.0))
    assert torch.equal(found.alpha.flip(-2), one.alpha)
    assert torch.equal(found.beta.flip(-2), one.beta)
    assert found.blurs is one.blurs


def test_segments_are_rows():
    segments = rows_of((4, 6))
    assert segments.end[0, 2, 3].tolist() == [3.0, 2.0]
    assert segments.start[0, 2, 3].tolist() == [-3.0, 2.0]


def test_training_learns_to_choose():
    config = ChoiceTraining(photos=(), batch=2, side=64)
    torch.manual_seed(0)
    network = Choice((8, 8, 8))
    adam = torch.optim.Adam(network.parameters(), 3e-3)
    found = []
    for loss, _ in zip(losses(config, [[kept()]], network, 0), range(30)):
        adam.zero_grad()
        loss.backward()
        adam.step()
        found.append(float(loss))
    assert found[-1] < 0.5 * found[0]


def test_a_pair_is_judged_by_a_choice_that_has_not_seen_it(tmp_path):
    for name, without in (("a", ["Cloth1"]), ("b", ["Wood1"])):
        facts = {"recipe": json.dumps({"without": without})}
        write_tensors(tmp_path / f"{name}.safetensors", Choice().half().state_dict(), facts)
    files = [tmp_path / "a.safetensors", tmp_path / "b.safetensors"]
    wanted = with_weights(Choice(), files[1]).state_dict()
    for name, tensor in unseeing(files, "2006_third/Wood1").state_dict().items():
        assert torch.equal(tensor, wanted[name])
    with pytest.raises(ValueError, match="--without"):
        unseeing(files, "2006_third/Midd1")


def test_a_choice_must_be_one(tmp_path):
    write_tensors(tmp_path / "other.safetensors", {"a": torch.zeros(3)})
    (tmp_path / "text.safetensors").write_text("none")
    for name in ("other", "text"):
        with pytest.raises(ValueError, match=f"{name}.safetensors: "):
            unseeing([tmp_path / f"{name}.safetensors"], "2006_third/Wood1")


def test_a_wrong_folder_ends_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["choice", "--photos", str(tmp_path), "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as stop:
        command(train_choice, ChoiceTraining, "choice")
    assert str(stop.value) == f"choice: no photograph in {tmp_path}: check --photos"


def test_the_recipe_of_what_ships_wants_photographs(tmp_path, monkeypatch):
    recipe = str(Path(samples.__file__).with_name("choice.yaml"))
    monkeypatch.setattr("sys.argv", ["choice", recipe, "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as stop:
        command(train_choice, ChoiceTraining, "choice")
    assert str(stop.value) == "choice: no photograph in no folder: check --photos"
    kept = yaml.safe_load((tmp_path / "out" / "recipe.yaml").read_text())
    assert (kept["captured"], kept["varied"]) == (250, 450)


@pytest.mark.slow
def test_a_choice_is_trained(photos, tmp_path):
    config = ChoiceTraining(photos=(photos,), out=tmp_path / "out", captured=2, steps=2, batch=2, side=64)
    made = train_choice(config)
    assert bool(with_weights(Choice(), made).unet.last.weight.isfinite().all())
    with safe_open(made, "pt") as file:
        assert json.loads(file.metadata()["recipe"])["captured"] == 2
