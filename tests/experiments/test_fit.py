"""The loop of training: what it says of a run, and logs."""

import json
from dataclasses import replace

import pytest
import torch
from torch import nn

from experiments.fit import Recipe, command


def test_the_mean_loss_since_the_last_checkpoint_is_said_and_logged(tmp_path, capsys):
    torch.manual_seed(0)
    network = nn.Linear(1, 1)

    def losses(start):
        for step in range(start, 5):
            yield 0 * network.weight.sum() + step

    Recipe(out=tmp_path, steps=5, batch=1, side=8, save=2).train(network, losses)
    log = [json.loads(line) for line in (tmp_path / "training" / "log.jsonl").read_text().splitlines()]
    assert log == [{"step": step, "mean loss": mean} for step, mean in ((2, 0.5), (4, 2.5), (5, 4.0))]
    assert "training: step 4 of 5, mean loss 2.5000\n" in capsys.readouterr().out


def test_a_run_that_stopped_goes_on_exactly(tmp_path):
    def run(out, until=None):
        torch.manual_seed(0)
        network = nn.Linear(3, 1)

        def losses(start):
            for step in range(start, 6 if until is None else until):
                yield (network(torch.full((1, 3), step + 1.0)) - step).square().sum()
            raise KeyboardInterrupt

        Recipe(out=out, steps=6, batch=1, side=8, rate=1e-2, save=2).train(network, losses)
        return network.weight

    whole = run(tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "parts", until=5)
    assert torch.equal(run(tmp_path / "parts"), whole)
    log = (tmp_path / "parts" / "training" / "log.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in log] == [2, 4, 6]


def test_a_run_of_another_recipe_is_refused_before_anything_is_done(tmp_path):
    """Samples of pairs that are left out are not taken for existing ones."""
    recipe = Recipe(out=tmp_path / "run", steps=1, batch=1, side=8)
    with recipe.folder():
        (recipe.out / "pairs").mkdir()
    with replace(recipe, device="cuda", save=7).folder():
        assert (recipe.out / "pairs").exists()
    with pytest.raises(ValueError, match=r"recipe[^/]*$"), replace(recipe, seed=1).folder():
        pytest.fail("not refused")


def test_a_recipe_is_a_file_that_the_command_line_changes(tmp_path, monkeypatch, capsys):
    file = tmp_path / "recipe.yaml"
    file.write_text(f"out: {tmp_path / 'run'}\nsteps: 7\nbatch: 2\nside: 8\n")
    found = []

    def train(config):
        found.append(config)
        with config.folder():
            return config.out

    monkeypatch.setattr("sys.argv", ["train", str(file), "--batch", "3"])
    command(train, Recipe, "train")
    assert found == [Recipe(out=tmp_path / "run", steps=7, batch=3, side=8)]
    for text, said in (
        ("step: 3", f"train: {file}: step: unknown key; did you mean 'steps'?"),
        ("steps: 3", f"train: {file}: out: missing"),
        ("steps: [", f"train: {file}: not valid YAML"),
        ("", f"train: {file}: Recipe: "),
    ):
        file.write_text(text)
        with pytest.raises(SystemExit) as stop:
            command(train, Recipe, "train")
        assert str(stop.value.code).startswith(said)
    assert (
        tmp_path / "run" / "recipe.yaml"
    ).read_text() == "steps: 7\nbatch: 3\nside: 8\nrate: 0.001\nseed: 0\n"
