"""Checkpoints of the paper's authors: their names, shapes and options, as those of PAT here.

Their repository, github.com/djbradyAtOpticalSciencesArizona/physicsAwareTransformer, trains under
DataParallel and saves a dict with `epoch`, `psnr` and `state_dict`, whose names begin with `module.`. The
files are read with `weights_only`: tensors and plain numbers, nothing that runs.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...networks.configs import PATConfig
from ...networks.paper import PAT

PREFIX = "module."


class Authors(NamedTuple):
    """A checkpoint of the paper's authors, converted to this package's PAT.

    Attributes:
        config: configuration of the network.
        state: weights by the names of this package's network, on the CPU, float32.
        facts: texts by name: "recipe", and "epoch" and "psnr" where the file states them.
    """

    config: PATConfig
    state: dict[str, Tensor]
    facts: dict[str, str]


def read_authors(path: str | Path) -> Authors:
    """Read an authors' checkpoint, of any number of inputs and any upscale factor.

    Returns:
        Configuration, weights and facts.

    Raises:
        FileNotFoundError: for a missing file.
        ValueError: for a file that would run code, is cut short, or holds another network, naming the first
            weight that does not fit.
    """
    content = _loaded(Path(path))
    state = content.get("state_dict", content) if isinstance(content, Mapping) else None
    weights = state if isinstance(state, Mapping) else {}
    if not weights or not all(isinstance(v, Tensor) and isinstance(k, str) for k, v in weights.items()):
        raise ValueError(f"{path}: holds no state_dict: give a best.pth.tar that the authors' train.py saved")
    state = {name.removeprefix(PREFIX): tensor for name, tensor in weights.items()}
    try:
        config = config_of(state)
        return Authors(config, renamed(state, config), _facts(content))
    except ValueError as error:
        raise ValueError(f"{path}: not a checkpoint of the authors' PAT: {error}") from None


def load_authors(path: str | Path) -> PAT:
    """Load the network of an authors' checkpoint (best.pth.tar).

    Returns:
        The network, on the CPU, for evaluation, its weights without gradients.

    Raises:
        FileNotFoundError: for a missing file.
        ValueError: as `read_authors`.
    """
    read = read_authors(path)
    network = PAT(read.config)
    network.load_state_dict(read.state)
    return network.eval().requires_grad_(False)


def config_of(state: Mapping[str, Tensor]) -> PATConfig:
    """Derive a network's configuration from its weights, by the authors' names without "module.".

    Returns:
        The configuration: sizes from the weights' shapes, and the biases, values and resizing of betas as in
        the authors' code.

    Raises:
        ValueError: if one of the three weights that show them is missing or has not four axes, or a size is
            beyond 1 to 1024. `renamed` checks the others.
    """
    betas = sum(re.fullmatch(r"pam\.b2s\.\d+\.weight", name) is not None for name in state)
    for name in ("init_feature.0.weight", "upscale.4.weight", "upscale.7.weight"):
        if name not in state or state[name].dim() != 4:
            raise ValueError(f"{name} is missing")
    dim, in_channels = state["init_feature.0.weight"].shape[:2]
    scale = round((len(state["upscale.4.weight"]) / max(dim, 1)) ** 0.5)
    sizes = {
        "betas": betas,
        "in_channels": in_channels,
        "out_channels": len(state["upscale.7.weight"]),
        "dim": dim,
        "scale": scale,
    }
    if min(sizes.values()) < 1 or max(sizes.values()) > 1024:
        raise ValueError(f"it has {', '.join(f'{name} {n}' for name, n in sizes.items())}")
    layout: dict[str, Any] = {"block_bias": False, "fusion_bias": True, "values_after_block": True}
    # Their loaders enlarge beta to alpha's size.
    return PATConfig(**sizes, **layout, equal_resolution=True)


def renamed(weights: Mapping[str, Tensor], config: PATConfig) -> dict[str, Tensor]:
    """Rename the authors' weights to the names of this package's PAT.

    The columns of the fusion's convolution are reordered too: the authors have alpha last, here it is first.

    Args:
        weights: weights by the authors' names, without "module.".
        config: configuration of the network that they must fit.

    Returns:
        Weights by name, in float32; tensors that are so already may be shared.

    Raises:
        ValueError: for the first weight that is missing, too many, of another shape, or not finite.
    """
    with torch.device("meta"):
        wanted = {name: tuple(t.shape) for name, t in PAT(config).state_dict().items()}
    names = dict(_names(config.betas))
    for theirs, ours in names.items():
        shape = tuple(weights[theirs].shape) if theirs in weights else "missing"
        if shape != wanted[ours]:
            raise ValueError(f"{theirs} is {shape}, wanted {wanted[ours]}")
    more = [name for name in weights if name not in names]
    if more:
        raise ValueError(f"{more[0]} is one weight too many")
    state = {ours: weights[theirs].float() for theirs, ours in names.items()}
    # Their fusion takes the attended betas first and alpha last; here alpha's columns are first.
    state["post.0.weight"] = state["post.0.weight"].roll(config.dim, 1)
    for name, tensor in state.items():
        if not tensor.isfinite().all():
            raise ValueError(f"{name} holds something other than finite numbers")
    return state


def _names(betas: int) -> Iterator[tuple[str, str]]:
    """Yield the authors' name of each weight, and the name here."""
    yield "init_feature.0.weight", "features.0.weight"
    for layer in (2, 4, 6):
        yield from _block(f"init_feature.{layer}", f"features.{layer}")
    for layer in (3, 5):
        for group in range(3):
            for branch in range(3):
                theirs = f"init_feature.{layer}.conv{branch + 1}_{group + 1}.0.weight"
                yield theirs, f"features.{layer}.groups.{group}.{branch}.weight"
            yield f"init_feature.{layer}.b_{group + 1}.weight", f"features.{layer}.fuse.{group}.weight"
    yield from _block("pam.rb", "engine.before")
    for kind in ("weight", "bias"):
        yield f"pam.b1.{kind}", f"engine.query.{kind}"
        for i in range(betas):
            yield f"pam.b2s.{i}.{kind}", f"engine.key.{i}.{kind}"
            yield f"pam.b3s.{i}.{kind}", f"engine.value.{i}.{kind}"
        yield f"pam.fusion.{kind}", f"post.0.{kind}"
    for layer in range(4):
        yield from _block(f"upscale.{layer}", f"post.{layer + 1}")
    for layer in (4, 6, 7):
        yield f"upscale.{layer}.weight", f"post.{layer + 1}.weight"


def _block(theirs: str, ours: str) -> Iterator[tuple[str, str]]:
    yield f"{theirs}.body.0.weight", f"{ours}.first.weight"
    yield f"{theirs}.body.2.weight", f"{ours}.second.weight"


def _loaded(path: Path) -> Any:
    """Return the content of the file, read without running any code in it."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    # Their psnr is a number of numpy's: these two make one, and nothing else.
    scalar = import_module("numpy.core.multiarray").scalar
    number = [(scalar, f"{core}.multiarray.scalar") for core in ("numpy.core", "numpy._core")]
    try:
        with torch.serialization.safe_globals(
            [*number, np.dtype, type(np.dtype(np.float64)), type(np.dtype("f4"))]
        ):
            return torch.load(path, map_location="cpu", weights_only=True)
    except UnpicklingError as error:
        what = re.search(r"GLOBAL (\S+)", str(error))
        named = f" ({what[1]})" if what else ""
        if what or "Unsupported class" in str(error):
            raise ValueError(
                f"{path}: refused, as it would run code when read{named}: get it from its authors"
            ) from None
        raise ValueError(f"{path}: not a checkpoint, or cut short: copy it again") from None
    except (EOFError, OSError, RuntimeError, ValueError, KeyError, IndexError, zipfile.BadZipFile):
        raise ValueError(f"{path}: not a checkpoint, or cut short: copy it again") from None


def _facts(content: Mapping[str, Any]) -> dict[str, str]:
    facts = {name: content[name] for name in ("epoch", "psnr") if isinstance(content.get(name), int | float)}
    return {"recipe": "the authors' checkpoint"} | {name: f"{value:g}" for name, value in facts.items()}
