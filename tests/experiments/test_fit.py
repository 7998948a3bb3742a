"""The loop of training: what it says of a run, and logs."""

import json
from dataclasses import replace

import pytest
import torch
from torch import nn

from experiments.fit import Recipe, fit


def test_the_mean_loss_since_the_last_checkpoint_is_said_and_logged(tmp_path, capsys):
    torch.manual_seed(0)
    network = nn.Linear(1, 1)

    def losses(start):
        for step in range(start, 5):
            yield 0 * network.weight.sum() + step

    fit(network, losses, tmp_path / "views", steps=5, rate=1e-3, save=2)
    log = [json.loads(line) for line in (tmp_path / "views" / "log.jsonl").read_text().splitlines()]
    assert log == [{"step": step, "mean loss": mean} for step, mean in ((2, 0.5), (4, 2.5), (5, 4.0))]
    assert "views: step 4 of 5, mean loss 2.5000\n" in capsys.readouterr().out


def test_a_run_that_stopped_goes_on_exactly(tmp_path):
    def run(out, until=None):
        torch.manual_seed(0)
        network = nn.Linear(3, 1)

        def losses(start):
            for step in range(start, 6 if until is None else until):
                yield (network(torch.full((1, 3), step + 1.0)) - step).square().sum()
            raise KeyboardInterrupt

        return fit(network, losses, out, steps=6, rate=1e-2, save=2).weight

    whole = run(tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "parts", until=5)
    assert torch.equal(run(tmp_path / "parts"), whole)
    log = (tmp_path / "parts" / "log.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in log] == [2, 4, 6]


def test_a_run_of_another_recipe_is_refused_before_anything_is_done(tmp_path):
    """Samples of pairs that were to be left out were taken as found."""
    recipe = Recipe(out=tmp_path / "run", steps=1, batch=1, side=8)
    with recipe.folder():
        (recipe.out / "pairs").mkdir()
    with replace(recipe, device="cuda", save=7).folder():
        assert (recipe.out / "pairs").exists()
    with pytest.raises(ValueError, match="another recipe"), replace(recipe, seed=1).folder():
        pytest.fail("not refused")
