"""Weights files: what is written is read back, what does not fit is named."""

import pytest
import torch
from safetensors.torch import save_file

from pat.networks.guided import GuidedPAT, GuidedPATConfig
from pat.networks.paper import PAT, PATConfig
from pat.networks.weights import load_weights, save_weights, shipped

NETWORKS = [PAT(PATConfig(betas=2, dim=8)), GuidedPAT(GuidedPATConfig(widths=(8, 8, 8, 8)))]


@pytest.mark.parametrize("network", NETWORKS, ids=["PAT", "GuidedPAT"])
def test_written_and_read_back(network, tmp_path):
    path = tmp_path / "w.safetensors"
    save_weights(network, path, facts={"seed": "0"})
    again = load_weights(path)
    assert type(again) is type(network)
    assert again.config == network.config
    assert all(torch.equal(v, again.state_dict()[k]) for k, v in network.state_dict().items())
    assert not any(p.requires_grad for p in again.parameters())


def test_shipped_weights_load_and_are_small():
    from pat.networks.weights import SHIPPED

    assert "mono-colour" in shipped()
    for name in shipped():
        load_weights(name)
        assert (SHIPPED / f"{name}.safetensors").stat().st_size < 10e6
        assert (SHIPPED / f"{name}.md").is_file()


def test_what_is_not_weights_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no weights 'mono-color'.*mono-colour"):
        load_weights("mono-color")
    cut = tmp_path / "cut.safetensors"
    save_weights(NETWORKS[0], cut)
    cut.write_bytes(cut.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"cut.safetensors: not a safetensors file"):
        load_weights(cut)
    other = tmp_path / "other.safetensors"
    save_file({"a": torch.zeros(1)}, other)
    with pytest.raises(ValueError, match="not weights of this package"):
        load_weights(other)


def test_weights_of_another_architecture_are_refused(tmp_path):
    path = tmp_path / "w.safetensors"
    network = PAT(PATConfig(dim=8))
    network.config = PATConfig(dim=16)
    save_weights(network, path)
    with pytest.raises(ValueError, match="do not fit the PAT"):
        load_weights(path)


def test_another_version_or_a_checkpoint_is_named(tmp_path):
    path = tmp_path / "w.safetensors"
    for version, message in (
        ("pat-weights 2", "it is 'pat-weights 2'"),
        ("pat-checkpoint 1", "a checkpoint of training"),
    ):
        save_file({"a": torch.zeros(1)}, path, {"format": version, "network": "PAT"})
        with pytest.raises(ValueError, match=message):
            load_weights(path)


def test_the_tensor_that_does_not_fit_is_named(tmp_path):
    network = GuidedPAT(GuidedPATConfig(widths=(8, 8, 8, 8)))
    network.config = GuidedPATConfig(widths=(8, 8, 8, 16))
    save_weights(network, tmp_path / "w.safetensors")
    with pytest.raises(ValueError, match=r"do not fit .*: \S+ is \(.*\), wanted \("):
        load_weights(tmp_path / "w.safetensors")
