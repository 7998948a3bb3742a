"""Checkpoints with the whole state of a run: tensors and JSON, nothing pickled."""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.swa_utils import AveragedModel

from pat.networks.weights import misfit
from pat.support.tensor_files import read_tensors, write_tensors

FORMAT = "pat-checkpoint 1"
RETAINED = 2
FACTS: Mapping[str, tuple[type, ...]] = {
    "step": (int,),
    "best": (float, int),
    "minutes": (float, int),
    "done": (bool,),
    "recipe": (str,),
}
"""Entries of a checkpoint beside its tensors, with their types."""
LONGEST = 1e7
"""Minutes above which a checkpoint's time counts as damaged: 19 years."""


class Checkpoint(NamedTuple):
    """State of a run.

    Attributes:
        tensors: weights, averaged weights and optimiser's state, by names that begin "network/", "average/"
            and "optimiser/".
        facts: "step"; "best" validation PSNR so far, dB; "minutes" spent; "done", True for a finished run;
            and "recipe" as YAML text.
    """

    tensors: dict[str, Tensor]
    facts: dict[str, Any]


def collect(
    network: nn.Module, optimiser: Optimizer, average: AveragedModel, facts: Mapping[str, Any]
) -> Checkpoint:
    """Collect the state of a run: weights, their average, and the optimiser's state.

    Args:
        facts: the entries of `Checkpoint.facts`, not checked.

    Returns:
        The checkpoint; tensors are not copied, so that training changes them.
    """
    tensors = {f"network/{k}": v for k, v in network.state_dict().items()}
    tensors |= {f"average/{k}": v for k, v in average.state_dict().items()}
    for i, state in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser/{i}/{k}": v for k, v in state.items()}
    return Checkpoint(tensors, dict(facts))


def restore(checkpoint: Checkpoint, network: nn.Module, optimiser: Optimizer, average: AveragedModel) -> None:
    """Restore the state of a run into network, optimiser and average, in place.

    Raises:
        ValueError: if the checkpoint is of another network or optimiser; nothing is changed then.
    """
    parts: dict[str, dict[str, Tensor]] = {"network": {}, "average": {}, "optimiser": {}}
    for name, tensor in checkpoint.tensors.items():
        section, _, rest = name.partition("/")
        parts.setdefault(section, {})[rest] = tensor
    wrong = misfit(network, parts["network"]) or misfit(average, parts["average"])
    if wrong:
        raise ValueError(f"the checkpoint is of another network ({wrong}): give its recipe, or another --out")
    state = _state(parts["optimiser"], optimiser)
    network.load_state_dict(parts["network"])
    average.load_state_dict(parts["average"])
    optimiser.load_state_dict(optimiser.state_dict() | {"state": state})


def _state(tensors: Mapping[str, Tensor], optimiser: Optimizer) -> dict[int, dict[str, Tensor]]:
    """Optimiser state by number of the parameter. Raises ValueError if shapes are other parameters'."""
    shapes = [tuple(p.shape) for group in optimiser.param_groups for p in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        i, _, key = name.partition("/")
        number = int(i) if i.isdecimal() else len(shapes)
        if number >= len(shapes) or tuple(tensor.shape) not in ((), shapes[number]):
            raise ValueError(f"the checkpoint is of another optimiser ({name}): give another --out")
        state.setdefault(number, {})[key] = tensor
    return state


def write_checkpoint(folder: Path, checkpoint: Checkpoint) -> Path:
    """Write a checkpoint into a folder atomically, and remove all but the two of the latest steps.

    Returns:
        Its file, named after the step.

    Raises:
        OSError: if it cannot be written, on a full disk for instance; older ones stay.
        RuntimeError: for tensors that share memory.
    """
    step = checkpoint.facts["step"]
    path = folder / f"step-{step:08d}.safetensors"
    try:
        write_tensors(path, checkpoint.tensors, {"format": FORMAT, "facts": json.dumps(checkpoint.facts)})
    except OSError as error:
        raise OSError(_no_room(folder, step, checkpoint.tensors, error)) from None
    for old in _files(folder)[RETAINED:]:
        old.unlink()
    return path


def newest_checkpoint(folder: Path) -> Checkpoint | None:
    """Read the newest readable checkpoint of a folder.

    Returns:
        The checkpoint, of the latest step that can be read; None if the folder has none or is missing.

    Raises:
        ValueError: if the folder has checkpoints and none can be read, so that no run starts again by
            accident.
    """
    files = _files(folder)
    newest = next((checkpoint for path in files if (checkpoint := read_checkpoint(path))), None)
    if files and newest is None:
        names = ", ".join(path.name for path in files)
        raise ValueError(
            f"{folder}: no checkpoint there can be read ({names}), so this run cannot continue: "
            "restore one of them from a copy, or remove these files to begin again at step 0, "
            "or give another --out"
        )
    return newest


def read_checkpoint(path: Path) -> Checkpoint | None:
    """Read a checkpoint file.

    Returns:
        The checkpoint, tensors on the CPU; None for a file that cannot be read or is no checkpoint.
    """
    try:
        tensors, metadata = read_tensors(path)
        facts = json.loads(metadata.get("facts", "null"))
    except (OSError, RecursionError, ValueError):
        return None
    whole = metadata.get("format") == FORMAT and _are_facts(facts)
    return Checkpoint(tensors, facts) if whole else None


def _are_facts(facts: object) -> bool:
    if not isinstance(facts, dict) or any(type(facts.get(n)) not in kinds for n, kinds in FACTS.items()):
        return False
    return facts["step"] >= 0 and 0 <= facts["minutes"] < LONGEST and not math.isnan(facts["best"])


def _files(folder: Path) -> list[Path]:
    """Checkpoint files, newest first."""
    files = [p for p in folder.glob("step-*.safetensors") if re.fullmatch(r"step-\d+", p.stem)]
    return sorted(files, reverse=True)


def _no_room(folder: Path, step: int, tensors: Mapping[str, Tensor], error: Exception) -> str:
    wanted = sum(t.numel() * t.element_size() for t in tensors.values()) / 2**20
    free = shutil.disk_usage(folder if folder.is_dir() else folder.parent).free / 2**20
    last = next((f"the last good one, {p}, is intact" for p in _files(folder)), "there is no older one")
    reason = " ".join(str(error).split())
    return (
        f"the checkpoint of step {step} ({wanted:.0f} MiB) could not be written to {folder} ({free:.0f} MiB "
        f"free): {reason}; {last}: make room and give the same command again"
    )
