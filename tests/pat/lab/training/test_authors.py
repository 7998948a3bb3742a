"""The authors' checkpoints: their outputs to 1e-9, their files read, everything else refused in a line."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from arraygeom import Link, NearestVoxels, Pair, Positions, Rectified, View
from arraygeom.fields.grid import FieldOnGrid
from pat.lab.training.authors import _names, load_authors, read_authors
from pat.matching.inputs import Inputs
from pat.networks.configs import PATConfig
from pat.networks.paper import PAT
from pat.networks.weights import load_weights, save_weights

CASES = ("two", "four", "two_x2")
LAYOUT = {"block_bias": False, "fusion_bias": True, "values_after_block": True, "equal_resolution": True}


def made_weights(shapes: dict[str, list[int]]) -> dict[str, torch.Tensor]:
    """The made-up weights of the reference, by its README."""
    r = np.random.RandomState(7)
    drawn = {}
    for name in sorted(shapes):
        values = r.standard_normal(shapes[name])
        few = np.sqrt(np.prod(shapes[name][1:])) if len(shapes[name]) > 1 else 10.0
        drawn[name] = torch.from_numpy(values / few)
    return {name: drawn[name] for name in shapes}


def made_inputs(case: dict) -> tuple[torch.Tensor, list[torch.Tensor], list[torch.Tensor]]:
    """Alpha, the betas, and the positions (h w, samples, 2) in each, (x, y), by its README."""
    r = np.random.RandomState(11)
    (h, w), (hb, wb), c, betas = case["alpha"], case["beta"], case["in_channel"], case["num_input"] - 1
    alpha = torch.from_numpy(r.random_sample((1, c, h, w)))
    images = [torch.from_numpy(r.random_sample((1, c, hb, wb))) for _ in range(betas)]
    positions = []
    for _ in range(betas):
        rows = r.randint(0, hb, (1, h * w, case["samples"]))
        columns = r.randint(0, wb, (1, h * w, case["samples"]))
        positions.append(torch.from_numpy(np.stack([columns[0], rows[0]], -1)).double())
    return alpha, images, positions


def listed(positions: torch.Tensor, width: int) -> FieldOnGrid:
    """A field of given positions (h w, samples, 2), pixel by pixel."""

    def at(x: torch.Tensor) -> Positions:
        xy = positions[(x[:, 1] * width + x[:, 0]).round().long()]
        return Positions(xy, torch.ones(xy.shape[:-1], dtype=torch.bool))

    return FieldOnGrid(at, positions.shape[1], None)


def save(path: Path, state: dict[str, torch.Tensor], **more) -> Path:
    """A checkpoint as their train.py saves it: names of DataParallel, psnr a number of numpy's."""
    named = {f"module.{k}": v for k, v in state.items()}
    torch.save({"epoch": 31, "state_dict": named, "psnr": np.float64(29.5)} | more, path)
    return path


def authors_state(network: PAT) -> dict[str, torch.Tensor]:
    """A network's weights by the authors' names."""
    own = network.state_dict()
    state = {theirs: own[ours] for theirs, ours in _names(network.config.betas)}
    return state | {"pam.fusion.weight": own["post.0.weight"].roll(-network.config.dim, 1)}


def small(**options) -> PAT:
    torch.manual_seed(3)
    return PAT(PATConfig(dim=8, **LAYOUT, **options))


@pytest.fixture(params=CASES)
def case(request, shared_data, tmp_path):
    folder = shared_data / "authors_network"
    facts = json.loads((folder / "reference.json").read_text())[request.param]
    outputs = np.load(folder / "reference.npz")
    weights = made_weights(dict(facts["weights"]))
    # Saved in float64, read in float32: the network is given the float64 numbers again.
    network = load_authors(save(tmp_path / "best.pth.tar", weights)).double()
    reread = read_authors(tmp_path / "best.pth.tar")
    network.load_state_dict({name: _exact(name, weights, reread.config) for name in reread.state})
    return facts, network, outputs[request.param], outputs[f"{request.param}_attention"]


def _exact(ours: str, weights: dict[str, torch.Tensor], config: PATConfig) -> torch.Tensor:
    theirs = {o: t for t, o in _names(config.betas)}[ours]
    return weights[theirs].roll(config.dim, 1) if ours == "post.0.weight" else weights[theirs]


def test_their_outputs_image_and_attention(case):
    facts, network, image, attention = case
    alpha, betas, positions = made_inputs(facts)
    fields = [listed(p, facts["alpha"][1]) for p in positions]
    fused, compared = network.compare(Inputs.from_images(alpha, betas, fields))
    assert np.abs(fused.image.numpy() - image).max() < 1e-9
    for one, where, wanted in zip(compared, positions, attention, strict=True):
        x, y = where.long().unbind(-1)
        score = torch.einsum("dn,dnl->nl", one.query[0].flatten(1), one.key[0][:, y, x])
        assert np.abs(score.softmax(-1).numpy() - wanted).max() < 1e-9


@pytest.mark.parametrize("field", [NearestVoxels(count=7, window=6), Rectified(8, alpha_is="left")])
def test_our_fields_give_what_their_formula_gives_at_the_same_pixels(case, field):
    """Explicit lists, as theirs are, of the pixels that a field of ours names, against the field itself."""
    facts, network, *_ = case
    alpha, betas, _ = made_inputs(facts)
    # F of a rectified pair: the line of (x, y) is the row y.
    F = torch.tensor([[0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]], dtype=torch.float64)
    view = View(hw=tuple(facts["alpha"]))
    pair = Pair(view, view, link=Link(F, torch.eye(3, dtype=torch.float64)))
    betas = [torch.nn.functional.interpolate(b, size=facts["alpha"], mode="bilinear") for b in betas]
    ours = [FieldOnGrid.from_field(field, pair) for _ in betas]
    found = network(Inputs.from_images(alpha, betas, ours)).image
    h, w = facts["alpha"]
    y, x = torch.meshgrid(torch.arange(h).double(), torch.arange(w).double(), indexing="ij")
    pixels = torch.stack([x, y], -1).reshape(-1, 2)
    wanted = _by_lists(network, alpha, betas, [_pixels_of(field, pair, p, ours[0].samples) for p in pixels])
    assert (found - wanted).abs().max() < 1e-9


def _pixels_of(field, pair: Pair, pixel: torch.Tensor, samples: int) -> torch.Tensor:
    """The pixels (n, 2) of beta a field names for one of alpha's; short segments repeat some; each counts."""
    found = field(pair, pixel[None])
    if isinstance(found, Positions):
        return found.xy[0][found.mask[0]]
    share = torch.linspace(0, 1, samples, dtype=torch.float64)[:, None]
    return (found.start + share * (found.end - found.start) + 0.5).floor()


def _by_lists(network: PAT, alpha, betas, lists) -> torch.Tensor:
    """The network with attention as in the paper's equation 3 to 5, pixel by pixel."""
    own, others = network.features(alpha), [network.features(b) for b in betas]
    query = network.engine.query(network.engine.before(own))[0].flatten(1)
    parts = [own]
    for f, key, value in zip(others, network.engine.key, network.engine.value):
        after = network.engine.before(f)
        k, v = key(after)[0], value(after)[0]
        columns = []
        for n, xy in enumerate(lists):
            x, y = xy.long().unbind(-1)
            columns.append(v[:, y, x] @ (query[:, n] @ k[:, y, x]).softmax(-1))
        parts.append(torch.stack(columns, -1).reshape(1, -1, *alpha.shape[-2:]))
    return network.post(torch.cat(parts, 1))


@pytest.mark.parametrize("options", [{}, {"betas": 3, "in_channels": 1}, {"scale": 2}, {"scale": 4}])
def test_a_checkpoint_as_theirs_round_trips(options, tmp_path):
    network = small(**options)
    path = save(tmp_path / "best.pth.tar", authors_state(network))
    found = load_authors(path)
    assert found.config == network.config
    for name, tensor in network.state_dict().items():
        assert torch.equal(found.state_dict()[name], tensor), name
    assert read_authors(path).facts == {"recipe": "the authors' checkpoint", "epoch": "31", "psnr": "29.5"}
    save_weights(found, tmp_path / "kept.safetensors")
    assert load_weights(tmp_path / "kept.safetensors").config == network.config


def test_a_bare_state_dict_and_names_without_module_are_read(tmp_path):
    torch.save(authors_state(small()), tmp_path / "bare.pth")
    assert load_authors(tmp_path / "bare.pth").config.betas == 1


class _Runs:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_a_pickle_that_would_run_code_is_refused_in_a_line(tmp_path):
    path = save(tmp_path / "best.pth.tar", authors_state(small()), epoch=_Runs(tmp_path / "ran"))
    with pytest.raises(ValueError, match="code") as refused:
        load_authors(path)
    assert not (tmp_path / "ran").exists()
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 300


@pytest.mark.parametrize("share", [None, 0.0, 0.001, 0.3, 0.9, 0.999])
def test_a_text_or_a_file_cut_short_is_refused_in_a_line(share, tmp_path):
    whole = save(tmp_path / "whole", authors_state(small())).read_bytes()
    (tmp_path / "cut").write_bytes(b"# A text\n" if share is None else whole[: int(len(whole) * share)])
    with pytest.raises(ValueError, match="short") as refused:
        load_authors(tmp_path / "cut")
    assert "\n" not in str(refused.value)


def changed(**changes):
    state = authors_state(small()) | {name.replace("__", "."): tensor for name, tensor in changes.items()}
    return {name: tensor for name, tensor in state.items() if tensor is not None}


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (changed(pam__b1__bias=None), "pam.b1.bias"),
        (changed(pam__b1__bias=torch.zeros(9)), r"pam.b1.bias.*\(9,\)"),
        (changed(pam__more=torch.zeros(9)), "pam.more"),
        (changed(upscale__4__weight=None), "upscale.4.weight"),
        (changed(pam__b1__bias=torch.full((8,), torch.nan)), "engine.query.bias"),
        ({"layer1.0.conv1.weight": torch.zeros(2, 3, 3, 3)}, "init_feature.0.weight"),
        (torch.nn.Linear(2, 3).state_dict(), "init_feature.0.weight"),
    ],
)
def test_checkpoints_of_other_networks_name_what_does_not_fit_first(state, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        load_authors(save(tmp_path / "other", state))


@pytest.mark.parametrize(
    "content", [{"epoch": 3}, [1, 2], {}, {"state_dict": {"a": 1}}, {"state_dict": [1]}, torch.zeros(3)]
)
def test_files_without_weights_are_refused(content, tmp_path):
    torch.save(content, tmp_path / "other")
    with pytest.raises(ValueError, match="state_dict"):
        load_authors(tmp_path / "other")


def test_no_file_is_said(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_authors(tmp_path / "none")
