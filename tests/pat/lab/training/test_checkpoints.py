"""Checkpoints and validation: what does not fit is refused, and changes nothing."""

import pytest
import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel

from pat.lab.training.checkpoints import collect, restore
from pat.lab.training.losses import validation
from pat.networks.paper import PAT

from .runs import SMALL


def test_the_state_of_another_optimiser_changes_nothing():
    network = nn.Linear(3, 2)
    optimiser, average = torch.optim.Adam(network.parameters()), AveragedModel(network)
    network(torch.ones(3)).sum().backward()
    optimiser.step()
    facts = {"step": 1, "best": 0.0, "minutes": 0.0, "done": False, "recipe": ""}
    checkpoint = collect(network, optimiser, average, facts)
    checkpoint.tensors["optimiser/7/exp_avg"] = torch.zeros(2)
    other = nn.Linear(3, 2)
    before = other.weight.clone()
    with pytest.raises(ValueError, match="optimiser"):
        restore(checkpoint, other, torch.optim.Adam(other.parameters()), AveragedModel(other))
    assert torch.equal(other.weight, before)


def test_there_is_nothing_to_validate_on():
    with pytest.raises(ValueError, match="samples"):
        validation(PAT(SMALL), [])
