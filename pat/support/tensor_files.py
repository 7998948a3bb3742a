"""Tensors in safetensors files, written atomically and checked by a digest."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from arraygeom.runtime.atomic import write_atomically

Network = TypeVar("Network", bound=nn.Module)


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] = {}) -> None:
    """Write tensors and metadata to a safetensors file, atomically, with a digest of the tensors.

    Missing folders are made.

    Args:
        metadata: texts by name to store beside the digest, which takes the name "digest".

    Raises:
        RuntimeError: for sparse tensors, and contiguous ones on the CPU that share memory.
        OSError: naming the file, if writing fails (a full disk, a folder of that name).
    """
    whole = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    try:
        with write_atomically(path) as temporary:
            save_file(whole, temporary, {**metadata, DIGEST: digest(whole)})
    except SafetensorError as error:
        raise OSError(f"{path}: {' '.join(str(error).split())}") from None


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read a safetensors file.

    Returns:
        Its tensors by name, on the CPU, and its metadata, texts by name (with the digest, if it has one).

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: naming the path, if it is a folder or a pipe, cannot be read, is no safetensors file, or
            is damaged (see `undamaged`).
    """
    if path.exists() and not path.is_file():  # a pipe would be waited for
        raise ValueError(f"{path}: no file, but a folder or a pipe")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: {not_whole(error)}") from None
    if not undamaged(tensors, metadata):
        raise ValueError(f"{path}: {DAMAGED}")
    return tensors, metadata


def with_weights(network: Network, path: Path) -> Network:
    """Load a file's weights into a network in place, and set it to evaluation without gradients.

    Returns:
        The same network.

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: naming the file, as `read_tensors`; or if its names or shapes are not this network's,
            which then may hold some of its weights.
    """
    try:
        network.load_state_dict(read_tensors(path)[0])
    except RuntimeError:
        name = type(network).__name__
        raise ValueError(f"{path}: not the weights of a {name}: train it again, or copy it again") from None
    return network.eval().requires_grad_(False)


def not_whole(error: Exception) -> str:
    """Return the message for a file that safetensors refuses with `error`."""
    return f"not a safetensors file ({' '.join(str(error).split())}); was it copied whole?"


DAMAGED = "its numbers are not those that were written: copy it again"
DIGEST = "digest"
"""Metadata entry that holds the digest of all tensors."""


def digest(tensors: Mapping[str, Tensor]) -> str:
    """Return a digest of the names, types, shapes and bytes of tensors, as 32 hexadecimal digits.

    It does not depend on their order. A safetensors file with one changed bit is still valid; this finds it.
    """
    total = hashlib.blake2b(digest_size=16)
    for name, tensor in sorted(tensors.items()):
        total.update(f"{name} {tuple(tensor.shape)} {tensor.dtype};".encode())
        total.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return total.hexdigest()


def undamaged(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> bool:
    """Return True if tensors match the digest in their metadata, or the metadata has none (older files)."""
    return DIGEST not in metadata or metadata[DIGEST] == digest(tensors)
