"""Tensors in safetensors files, written atomically."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from arraygeom.atomic import write_atomically


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None) -> None:
    """Write tensors atomically. Raises OSError that names the file if that fails, on a full disk for instance."""
    whole = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    try:
        with write_atomically(path) as temporary:
            save_file(whole, temporary, dict(metadata or {}))
    except SafetensorError as error:
        raise OSError(f"{path}: {' '.join(str(error).split())}") from None
