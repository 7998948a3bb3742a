"""Tensors on disk: nothing half-written, and the file named when there is no room."""

import os

import pytest
import torch
from safetensors.torch import load_file
from torch import nn

from pat.support.tensor_files import read_tensors, with_weights, write_tensors
from tests.processes import room_for


def test_no_room_names_the_file_and_leaves_the_former_one(tmp_path):
    path = tmp_path / "a.safetensors"
    write_tensors(path, {"a": torch.arange(4.0, requires_grad=True)}, {"made": "first"})
    with room_for(1000), pytest.raises(OSError, match=r"a\.safetensors: "):
        write_tensors(path, {"a": torch.zeros(20, 50).mT})
    assert os.listdir(tmp_path) == ["a.safetensors"]
    assert torch.equal(load_file(path)["a"], torch.arange(4.0))


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (lambda content: content[:-4], "safetensors"),
        (lambda content: b"", "safetensors"),
        (lambda content: content[:-1] + bytes([content[-1] ^ 64]), "numbers"),
    ],
)
def test_what_is_damaged_is_named(tmp_path, damage, problem):
    """One changed bit of the weights is detected."""
    path = tmp_path / "a.safetensors"
    write_tensors(path, nn.Linear(3, 2).state_dict())
    assert with_weights(nn.Linear(3, 2), path).weight.shape == (2, 3)
    with pytest.raises(ValueError, match=r"a\.safetensors: "):
        with_weights(nn.Linear(2, 2), path)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=rf"a\.safetensors: .*{problem}"):
        read_tensors(path)
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"a\.safetensors"):
        read_tensors(path)
