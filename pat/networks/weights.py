"""Weights as safetensors: the file states their network, and nothing is unpickled."""

from __future__ import annotations

import dataclasses
import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from ..support.blocks import in_bfloat16
from ..support.schema import from_document, near
from ..support.tensor_files import DAMAGED, not_whole, undamaged, write_tensors
from .configs import CONFIGS
from .denoiser import DenoiserConfig, LowLightNetwork
from .guided import GuidedPAT
from .paper import PAT, AttentionEngine

SHIPPED = Path(__file__).parent / "shipped"
DENOISER = Path(__file__).parent / "denoisers" / "low-light.safetensors"
FORMAT = "pat-weights 1"
Network = PAT | GuidedPAT
NETWORKS: Mapping[str, tuple[Any, Any]] = {
    network.__name__: (network, CONFIGS[network.__name__]) for network in get_args(Network)
}
DENOISERS = {"LowLightNetwork": (LowLightNetwork, DenoiserConfig)}

LARGEST, MOST_ENTRIES = 1024, 16
"""Largest number in a configuration, and largest length of a list of them. The largest shipped
are 48 and 4."""

STEP = ".step"
"""Suffix of the name of steps, one for each output channel, in which a tensor is stored as whole numbers."""

Precision = Literal["float32", "bfloat16"]


def save_weights(
    network: Network | LowLightNetwork,
    path: str | Path,
    *,
    facts: Mapping[str, str] | None = None,
    in_bytes: bool = False,
) -> None:
    """Write a network's weights and configuration to a safetensors file, atomically.

    Missing folders are made.

    Args:
        facts: texts by name (recipe, seed, figures) to store in the file too, other than "format", "network",
            "config" and "digest"; None for none.
        in_bytes: True to round weights other than biases to a byte each, in 255 steps by output channel.

    Raises:
        OSError: naming the file, if it cannot be written.
    """
    metadata = {
        "format": FORMAT,
        "network": type(network).__name__,
        "config": json.dumps(dataclasses.asdict(network.config)),
        **(facts or {}),
    }
    state: Mapping[str, Tensor] = network.state_dict()
    write_tensors(Path(path), _in_steps(state) if in_bytes else state, metadata)


def _in_steps(state: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """Return weights as whole numbers of a byte, with the step of each output channel; biases as they are."""
    largest = {
        name: tensor.abs().amax(tuple(range(1, tensor.dim())), keepdim=True).clamp(min=1e-12)
        for name, tensor in state.items()
        if tensor.dim() > 1
    }
    numbers = {name: (127 * state[name] / most).round().to(torch.int8) for name, most in largest.items()}
    return {**state, **numbers, **{name + STEP: most / 127 for name, most in largest.items()}}


def load_weights(name: str | Path, *, precision: Precision = "float32") -> Network:
    """Load the network of a weights file, or of a name that ships with the package.

    With `precision` "bfloat16" PAT's convolutions outside attention are computed in that, faster and less
    exactly (`set_precision`); of GuidedPAT, which has none, nothing is. A shipped name comes before a file.

    Returns:
        The network on the CPU, for evaluation, its weights without gradients.

    Raises:
        FileNotFoundError: for no such file or name.
        ValueError: for a file that is not of this format, is damaged or does not fit, another precision, or
            bfloat16 where neither the processor has it (AVX-512 BF16) nor CUDA is there.
    """
    if precision not in get_args(Precision):
        raise ValueError(f"precision is {precision!r}; wanted one of {', '.join(get_args(Precision))}")
    network: Network = _load(find_weights(name), NETWORKS)
    multiplied = torch.cpu._is_avx512_bf16_supported() or torch.cuda.is_available()
    if precision == "bfloat16" and not multiplied:
        raise ValueError("this processor does not multiply bfloat16: leave the precision at float32")
    set_precision(network, precision)
    return network


def new_network(config: Any, start: Path | None = None) -> Network:
    """Make a network of a configuration.

    Args:
        config: `PATConfig` or `GuidedPATConfig`.
        start: weights file to start from; None for random weights.

    Returns:
        The network on the CPU, for training; with `start`, its weights are copied.

    Raises:
        TypeError: for a configuration of another class.
        FileNotFoundError: for a missing `start`.
        ValueError: for weights of another network or configuration, and as `load_weights`.
    """
    makers = {of: made for made, of in NETWORKS.values()}
    if type(config) not in makers:
        wanted = " or ".join(of.__name__ for of in makers)
        raise TypeError(f"config is a {type(config).__name__}: wanted a {wanted}")
    network: Network = makers[type(config)](config)
    if start is not None:
        weights = load_weights(start)
        if type(weights) is not type(network) or weights.config != config:
            raise ValueError(
                f"start: {start} holds a {type(weights).__name__} of {weights.config}, "
                f"the recipe is for a {type(network).__name__} of {config}: give its own recipe, "
                "or leave `start` out"
            )
        network.load_state_dict(weights.state_dict())
    return network


def weights_for(bands: Sequence[int]) -> str:
    """Return the name of the shipped weights for betas of these numbers of bands."""
    return "mono-colour" if all(count == 3 for count in bands) else "mono-spectral"


def set_precision(network: nn.Module, precision: Precision, *, compiled: bool = False) -> None:
    """Set the precision of a network's convolutions in place, and optionally compile them by torch.compile.

    Weights and results stay float32: `forward` of the network's children is replaced by one under autocast.
    An `AttentionEngine` with its convolutions, and a `ModuleList`, are left out.

    Args:
        precision: "bfloat16"; any other changes nothing, and "float32" does not undo bfloat16.
        compiled: True to compile the same children.
    """
    for module in network.children():
        if isinstance(module, (AttentionEngine, nn.ModuleList)):
            continue
        if precision == "bfloat16":
            in_bfloat16(module)
        if compiled:
            module.compile()


def load_denoiser(path: str | Path = DENOISER) -> LowLightNetwork:
    """Load the network that removes noise from a weights file; by default the shipped one.

    Returns:
        The network on the CPU, for evaluation, its weights without gradients.

    Raises:
        ValueError: for a file that is missing, not of this format, damaged, or does not fit.
    """
    return _load(Path(path), DENOISERS)


def _load(path: Path, networks: Mapping[str, tuple[Any, Any]]) -> Any:
    """Load the network of a file, of one of these kinds."""
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            network, config = _described(path, metadata, networks)
            names = list(file.keys())
            shapes = {name: file.get_slice(name).get_shape() for name in names if not name.endswith(STEP)}
            _check_shapes(path, network, config, shapes)
            tensors = {name: file.get_tensor(name) for name in names}
    except (SafetensorError, OSError) as error:
        if _is_of_pytorch(path):
            raise ValueError(
                f"{path}: a checkpoint of PyTorch's: "
                "`pat lab weights import` makes weights of one of the paper's authors"
            ) from None
        raise ValueError(f"{path}: {not_whole(error)}") from None
    if not undamaged(tensors, metadata):
        raise ValueError(f"{path}: {DAMAGED}")
    state = {name: _with_step(path, name, tensors) for name in shapes}
    for name, tensor in state.items():
        if not tensor.is_floating_point() or not tensor.float().isfinite().all():
            raise ValueError(
                f"{path}: {name} holds something other than finite numbers: train it again, or copy it again"
            )
    made = network(config)
    made.load_state_dict(state)
    return made.eval().requires_grad_(False)


def _with_step(path: Path, name: str, tensors: Mapping[str, Tensor]) -> Tensor:
    """Return a tensor of a file, times its step if it is stored as whole numbers of one."""
    numbers, step = tensors[name], tensors.get(name + STEP)
    if step is None:
        return numbers
    if step.shape != (*numbers.shape[:1], *(1 for _ in numbers.shape[1:])):
        raise ValueError(f"{path}: the steps of {name} do not fit it: train it again, or copy it again")
    return numbers * step


def _is_of_pytorch(path: Path) -> bool:
    """Return True if torch.save wrote the file: other archives, such as NumPy's, are zip files, too."""
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return any(Path(name).name == "data.pkl" for name in archive.namelist())


def misfit(network: nn.Module, state: Mapping[str, Tensor]) -> str:
    """Describe the first tensor of a file's `state` that does not fit a network.

    Returns:
        A phrase on a tensor that is missing, too many, or of another shape; empty if all fit.
    """
    wanted_shapes, given_shapes = (
        {k: tuple(v.shape) for k, v in s.items()} for s in (network.state_dict(), state)
    )
    for name in [*wanted_shapes, *given_shapes]:
        if wanted_shapes.get(name) != given_shapes.get(name):
            return f"{name} is {given_shapes.get(name, 'missing')}, wanted {wanted_shapes.get(name, 'none')}"
    return ""


def shipped() -> tuple[str, ...]:
    """List the names of the weights in the package, sorted."""
    return tuple(sorted(p.stem for p in SHIPPED.glob("*.safetensors")))


def find_weights(name: str | Path) -> Path:
    """Find a weights file, shipped with the package or the user's own.

    Args:
        name: name of shipped weights ("mono-colour"), or else a path.

    Returns:
        The path.

    Raises:
        FileNotFoundError: if neither exists.
    """
    path = SHIPPED / f"{name}.safetensors" if str(name) in shipped() else Path(name)
    if path.is_file():
        return path
    raise FileNotFoundError(f"no weights '{name}': there is no such file{near(name, shipped())}")


def _described(
    path: Path, metadata: Mapping[str, str], networks: Mapping[str, tuple[Any, Any]]
) -> tuple[Callable[..., nn.Module], Any]:
    """Return the class of the network that a file describes, and its configuration, of plausible numbers."""
    if metadata.get("format", "").startswith("pat-checkpoint"):
        raise ValueError(
            f"{path}: a checkpoint of training: the weights are in best.safetensors, a folder above"
        )
    if metadata.get("format") != FORMAT or metadata.get("network") not in networks:
        said = f"it is '{metadata.get('format')}' of a {metadata.get('network')}"
        saying = f"'{FORMAT}' is wanted in the file's metadata, {said if metadata else 'it says nothing'}"
        raise ValueError(f"{path}: not weights of this package ({saying})")
    network, kind = networks[metadata["network"]]
    try:
        config: Any = from_document(kind, json.loads(metadata["config"]))  # type: ignore[arg-type]
        for name, value in dataclasses.asdict(config).items():
            _check_numbers(name, value)
    except (KeyError, RecursionError, TypeError, ValueError) as error:
        reason, _, _ = str(error).partition("; did you mean")  # nobody writes such a file by hand
        advice = "train it again, or take the weights that this version ships"
        raise ValueError(f"{path}: does not fit this version ({reason}): {advice}") from None
    return network, config


def _check_numbers(name: str, value: object) -> None:
    values = value if isinstance(value, tuple) else (value,)
    if len(values) > MOST_ENTRIES:
        raise ValueError(f"{name} has {len(values)} entries; at most {MOST_ENTRIES} are read")
    for number in values:
        if isinstance(number, int | float) and not isinstance(number, bool) and not 1 <= number <= LARGEST:
            raise ValueError(f"{name} is {number}; wanted 1 to {LARGEST}")


def _check_shapes(
    path: Path, network: Callable[..., nn.Module], config: object, shapes: Mapping[str, Sequence[int]]
) -> None:
    """Compare the shapes with the network's before it, or any tensor, takes memory."""
    try:
        with torch.device("meta"):
            made = network(config)
            wrong = misfit(made, {name: torch.empty(tuple(shape)) for name, shape in shapes.items()})
    except Exception as error:  # whatever a constructor runs into, the cause is the configuration
        raise ValueError(
            f"{path}: its configuration makes no network ({' '.join(str(error).split())[:200]})"
        ) from None
    if wrong:
        raise ValueError(
            f"{path}: the weights do not fit the {type(made).__name__} that the file describes: {wrong}"
        )
