"""Tensors on disk: nothing half-written, and the file named when there is no room."""

import os
import resource

import pytest
import torch
from safetensors.torch import load_file

from pat.support.tensor_files import write_tensors


def test_no_room_names_the_file_and_leaves_the_former_one(tmp_path):
    path = tmp_path / "a.safetensors"
    write_tensors(path, {"a": torch.arange(4.0, requires_grad=True)}, {"made": "first"})
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(OSError, match=r"a\.safetensors: .*(too large|No space)"):
            write_tensors(path, {"a": torch.zeros(20, 50).mT})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert os.listdir(tmp_path) == ["a.safetensors"]
    assert torch.equal(load_file(path)["a"], torch.arange(4.0))
