"""Weights files: what is written is read back, what does not fit is named."""

import dataclasses
import json
import resource

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from pat.networks.configs import GuidedPATConfig, PATConfig
from pat.networks.denoiser import DenoiserConfig
from pat.networks.guided import GuidedPAT
from pat.networks.paper import PAT
from pat.networks.weights import (
    FORMAT,
    SHIPPED,
    find_weights,
    load_weights,
    new_network,
    save_weights,
    shipped,
)

NETWORKS = [
    PAT(PATConfig(betas=2, dim=8)),
    GuidedPAT(GuidedPATConfig()),
    GuidedPAT(GuidedPATConfig(bands=None, keep_luminance=False, learned=False)),
]


@pytest.mark.parametrize("network", NETWORKS, ids=["PAT", "GuidedPAT", "classical"])
def test_written_and_read_back(network, tmp_path):
    path = tmp_path / "w.safetensors"
    save_weights(network, path, facts={"seed": "0"})
    again = load_weights(path)
    assert type(again) is type(network)
    assert again.config == network.config
    assert all(torch.equal(v, again.state_dict()[k]) for k, v in network.state_dict().items())
    assert not any(p.requires_grad for p in again.parameters())


def test_shipped_weights_load_and_are_small():
    assert "mono-colour" in shipped()
    for name in shipped():
        load_weights(name)
        assert (SHIPPED / f"{name}.safetensors").stat().st_size < 10e6
        assert (SHIPPED / f"{name}.md").is_file()


def test_what_is_not_weights_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"'mono-color'.*mono-colour"):
        load_weights("mono-color")
    save_weights(NETWORKS[0], tmp_path / "mine.safetensors")
    for name in (str(tmp_path / "mine"), f"../shipped/{shipped()[0]}", ""):
        with pytest.raises(FileNotFoundError):  # a name is one of the package, or a whole path
            find_weights(name)
    (tmp_path / "mine").touch()
    assert find_weights(str(tmp_path / "mine")) == tmp_path / "mine"
    cut = tmp_path / "cut.safetensors"
    save_weights(NETWORKS[0], cut)
    cut.write_bytes(cut.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"cut.safetensors: "):
        load_weights(cut)
    other = tmp_path / "other.safetensors"
    save_file({"a": torch.zeros(1)}, other)
    with pytest.raises(ValueError, match="not weights of this package"):
        load_weights(other)


def test_a_checkpoint_of_pytorch_is_said_to_be_one(tmp_path):
    torch.save({"state_dict": {}}, tmp_path / "best.pth.tar")
    with pytest.raises(ValueError, match=r"best.pth.tar: "):
        load_weights(tmp_path / "best.pth.tar")
    np.savez(tmp_path / "archive.npz", a=np.zeros(3))
    with pytest.raises(ValueError, match=r"archive.npz: "):
        load_weights(tmp_path / "archive.npz")


def test_another_version_or_a_checkpoint_is_named(tmp_path):
    path = tmp_path / "w.safetensors"
    for version, message in (
        ("pat-weights 2", "pat-weights 2"),
        ("pat-checkpoint 1", "checkpoint"),
    ):
        save_file({"a": torch.zeros(1)}, path, {"format": version, "network": "PAT"})
        with pytest.raises(ValueError, match=message):
            load_weights(path)


def test_the_tensor_that_does_not_fit_is_named(tmp_path):
    network = PAT(PATConfig(dim=8))
    network.config = PATConfig(dim=16)
    save_weights(network, tmp_path / "w.safetensors")
    with pytest.raises(ValueError, match="PAT"):
        load_weights(tmp_path / "w.safetensors")


def weights_file(path, config, network="GuidedPAT", state=None) -> None:
    text = config if isinstance(config, str) else json.dumps(config)
    metadata = {"format": FORMAT, "network": network, "config": text}
    save_file(state or {"a": torch.zeros(1)}, path, metadata)


@pytest.mark.parametrize(
    ("network", "config", "problem"),
    [
        ("GuidedPAT", {"bands": 10**9}, "bands.*1000000000"),
        ("GuidedPAT", {}, "GuidedPAT"),
        ("GuidedPAT", {"completion": [1] * 10**5}, "completion: "),
        ("GuidedPAT", {"bands": "x"}, "bands.*'x'"),
        ("PAT", {"dim": 10**9}, "dim.*1000000000"),
        ("GuidedPAT", {"bands": 0}, "bands"),
        ("GuidedPAT", {"bands": 10**400}, "bands: .*63 bits"),
        ("GuidedPAT", '{"bands": NaN}', "bands: "),
        ("GuidedPAT", '{"keep_luminance": Infinity}', "keep_luminance: "),
        ("GuidedPAT", {"nonsense": 1}, "nonsense: "),
        ("GuidedPAT", {"fine_head": 8}, "fine_head: "),
        ("BandwisePAT", {"bands": 3}, "not weights of this package"),
        ("PAT", {"dim": 1024, "betas": 1024, "scale": 1024}, "PAT"),
        ("PAT", {"betas": -1}, "betas"),
        ("PAT", {"interpolation": "cubic"}, "interpolation.*'cubic'"),
        ("PAT", "[1, 2]", "mapping"),
        ("PAT", "null", "mapping"),
        ("PAT", "not json", "version"),
        ("PAT", "[" * 100_000, "version"),
    ],
)
def test_hostile_configurations_are_refused_without_building_anything(tmp_path, network, config, problem):
    weights_file(tmp_path / "w.safetensors", config, network)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=rf"w.safetensors: .*{problem}"):
        load_weights(tmp_path / "w.safetensors")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300e3  # KiB


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_weights_that_are_not_finite_are_refused(tmp_path, bad):
    network = PAT(PATConfig(dim=8))
    next(network.parameters()).data.view(-1)[3] = bad
    save_weights(network, tmp_path / "w.safetensors")
    with pytest.raises(ValueError, match="numbers"):
        load_weights(tmp_path / "w.safetensors")


def test_weights_of_integers_are_refused(tmp_path):
    network = PAT(PATConfig(dim=8))
    state = {
        name: torch.zeros_like(tensor, dtype=torch.int32) for name, tensor in network.state_dict().items()
    }
    weights_file(tmp_path / "w.safetensors", dataclasses.asdict(network.config), "PAT", state)
    with pytest.raises(ValueError, match="numbers"):
        load_weights(tmp_path / "w.safetensors")


def test_configurations_of_no_network_are_named():
    with pytest.raises(TypeError, match="DenoiserConfig"):
        new_network(DenoiserConfig())
    with pytest.raises(ValueError, match=r"keep_luminance.*1 band"):
        new_network(GuidedPATConfig(bands=1))
