"""Weights as safetensors: which network they are for stands in the file, and nothing is unpickled."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from ..support.tensor_files import write_tensors
from .bandwise import BandwisePAT, BandwisePATConfig
from .guided import GuidedPAT, GuidedPATConfig
from .paper import PAT, PATConfig

SHIPPED = Path(__file__).parent / "shipped"
FORMAT = "pat-weights 1"
NETWORKS = {
    "PAT": (PAT, PATConfig),
    "GuidedPAT": (GuidedPAT, GuidedPATConfig),
    "BandwisePAT": (BandwisePAT, BandwisePATConfig),
}

Network = PAT | GuidedPAT | BandwisePAT


def save_weights(network: Network, path: str | Path, *, facts: Mapping[str, str] | None = None) -> None:
    """Write a network's weights and configuration; the file appears whole or not at all.

    `facts` (recipe, seed, figures) are kept beside them, as text.
    """
    metadata = {
        "format": FORMAT,
        "network": type(network).__name__,
        "config": json.dumps(dataclasses.asdict(network.config)),
        **(facts or {}),
    }
    write_tensors(Path(path), network.state_dict(), metadata)


def load_weights(name: str | Path) -> Network:
    """The network of a weights file, or of a name that ships with the package, ready for use.

    Raises FileNotFoundError for neither, ValueError for a file that is not of this format or does not fit.
    """
    path = find_weights(name)
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            state = {renamed(key): file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: not a safetensors file ({error}); was it copied whole?") from None
    network = _network(path, metadata)
    wrong = misfit(network, state)
    if wrong:
        raise ValueError(f"{path}: the weights do not fit the {metadata['network']} that the file describes: {wrong}")
    network.load_state_dict(state)
    return network.eval().requires_grad_(False)


_OLD_NAMES = {"trust": "confidence", "carry": "propagation"}
"""First words of parts and options of networks in files of earlier versions."""


def renamed(key: str) -> str:
    """The name, in this version, of a tensor or an option in a file of any version."""
    first, separator, rest = key.removeprefix("single.").partition("_" if "." not in key else ".")
    single = "single." if key.startswith("single.") else ""
    return single + _OLD_NAMES.get(first, first) + separator + rest


def misfit(network: nn.Module, state: Mapping[str, Tensor]) -> str:
    """The first tensor that is missing, too many, or of another shape than the network's; empty if all fit."""
    own = {k: tuple(v.shape) for k, v in network.state_dict().items()}
    given = {k: tuple(v.shape) for k, v in state.items()}
    for name in [*own, *given]:
        if own.get(name) != given.get(name):
            return f"{name} is {given.get(name, 'missing')}, wanted {own.get(name, 'none')}"
    return ""


def shipped() -> tuple[str, ...]:
    """Names of the weights in the package."""
    return tuple(sorted(p.stem for p in SHIPPED.glob("*.safetensors")))


def find_weights(name: str | Path) -> Path:
    """The file of shipped weights, or the path itself. Raises FileNotFoundError if there is neither."""
    for path in (SHIPPED / f"{name}.safetensors", Path(name)):
        if path.is_file():
            return path
    raise FileNotFoundError(f"no weights '{name}': neither a file nor one of {', '.join(shipped())}")


def _network(path: Path, metadata: Mapping[str, str]) -> Network:
    if metadata.get("format", "").startswith("pat-checkpoint"):
        raise ValueError(f"{path}: a checkpoint of training: the weights are in best.safetensors, a folder above")
    if metadata.get("format") != FORMAT or metadata.get("network") not in NETWORKS:
        found = f"it is '{metadata.get('format')}' of a {metadata.get('network')}" if metadata else "it says nothing"
        raise ValueError(f"{path}: not weights of this package ('{FORMAT}' is wanted in the file's metadata, {found})")
    network, config = NETWORKS[metadata["network"]]
    try:
        config_values = json.loads(metadata["config"]).items()
        values = {renamed(k): tuple(v) if isinstance(v, list) else v for k, v in config_values}
        return network(config(**values))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: its configuration does not fit this version ({error})") from None
