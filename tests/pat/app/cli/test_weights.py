"""`pat lab weights import`: a checkpoint as the authors save them becomes weights that fuse."""

from __future__ import annotations

import torch

from pat.lab.evaluation.protocols import rectified_fusion
from pat.networks.configs import PATConfig
from pat.networks.paper import PAT
from pat.networks.weights import load_weights
from tests.pat.commands import pat
from tests.pat.lab.training.test_authors import authors_state, save

LAYOUT = {"block_bias": False, "fusion_bias": True, "values_after_block": True, "equal_resolution": True}


def network() -> PAT:
    torch.manual_seed(1)
    return PAT(PATConfig(dim=8, **LAYOUT)).eval()


def test_imported_weights_fuse_as_the_network_does(tmp_path, capsys):
    made = network()
    save(tmp_path / "best.pth.tar", authors_state(made))
    pat(f"lab weights import {tmp_path / 'best.pth.tar'} --out {tmp_path / 'ours.safetensors'}")
    assert "PAT for 1 beta, images of 3 channels, enlarged 1x" in capsys.readouterr().err
    alpha, beta = torch.rand(1, 24, 40), torch.rand(3, 12, 20)
    imported = load_weights(tmp_path / "ours.safetensors")
    ours, wanted = (rectified_fusion(weights)(alpha, beta, 9.0).image for weights in (imported, made))
    assert torch.equal(ours, wanted)


def test_other_files_are_refused_in_a_line(tmp_path, refusal):
    (tmp_path / "none.tar").write_bytes(b"no checkpoint")
    said = refusal("lab", "weights", "import", tmp_path / "none.tar", "--out", tmp_path / "out.safetensors")
    assert "none.tar" in said
    assert not (tmp_path / "out.safetensors").exists()
