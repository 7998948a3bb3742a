"""The loop of training: what it says of a run, and logs."""

import json

import pytest
import torch
from torch import nn

from experiments.fit import fit


def test_the_mean_loss_since_the_last_checkpoint_is_said_and_logged(tmp_path, capsys):
    torch.manual_seed(0)
    network = nn.Linear(1, 1)

    def losses(start):
        for step in range(start, 5):
            yield 0 * network.weight.sum() + step

    fit(network, losses, tmp_path / "views", "", steps=5, rate=1e-3, save=2)
    log = [json.loads(line) for line in (tmp_path / "views" / "log.jsonl").read_text().splitlines()]
    assert log == [{"step": step, "mean loss": mean} for step, mean in ((2, 0.5), (4, 2.5), (5, 4.0))]
    assert "views: step 4 of 5, mean loss 2.5000\n" in capsys.readouterr().out


def test_a_run_of_another_recipe_is_refused(tmp_path):
    network = nn.Linear(1, 1)

    def losses(start):
        yield network.weight.square().sum()

    how = {"steps": 1, "rate": 1e-3, "save": 1}
    fit(network, losses, tmp_path, "one", **how)
    with pytest.raises(ValueError, match="another recipe"):
        fit(network, losses, tmp_path, "other", **how)
