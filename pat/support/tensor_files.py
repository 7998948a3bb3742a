"""Tensors in safetensors files, written atomically."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from arraygeom.atomic import write_atomically


def write_tensors(
    path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None
) -> None:
    """Write tensors atomically, with a digest of them (`undamaged`) beside the metadata.

    Raises OSError that names the file if that fails, on a full disk for instance.
    """
    whole = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    try:
        with write_atomically(path) as temporary:
            save_file(whole, temporary, {**(metadata or {}), DIGEST: digest(whole)})
    except SafetensorError as error:
        raise OSError(f"{path}: {' '.join(str(error).split())}") from None


DIGEST = "digest"
"""The entry of the metadata that holds the digest of all tensors."""


def digest(tensors: Mapping[str, Tensor]) -> str:
    """A digest of names, shapes and bytes: with a bit changed a file is still a valid safetensors file."""
    total = hashlib.blake2b(digest_size=16)
    for name, tensor in sorted(tensors.items()):
        total.update(f"{name} {tuple(tensor.shape)} {tensor.dtype};".encode())
        total.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return total.hexdigest()


def undamaged(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> bool:
    """Whether a file's tensors are those that were written; also for files from before there were digests."""
    return DIGEST not in metadata or metadata[DIGEST] == digest(tensors)
