"""Rig files: one module a format, one registry."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from types import ModuleType

from ..rig import Rig
from . import native
from .errors import RigFileError

READERS: dict[str, ModuleType] = {"native": native}
WRITERS: dict[str, ModuleType] = {"native": native}

__all__ = ["READERS", "WRITERS", "RigFileError", "read_rig", "write_rig"]


def read_rig(path: str | Path, *, format: str | None = None) -> Rig:
    """The rig of a file; its format is recognised unless named. Raises RigFileError, FileNotFoundError."""
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such rig file")
    return _reader(path, format).read(path)


def write_rig(rig: Rig, path: str | Path, *, format: str = "native") -> None:
    """Write a rig; the file appears whole or not at all."""
    path = Path(path)
    text = WRITERS[format].write(rig)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".part")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def _reader(path: Path, format: str | None) -> ModuleType:
    if format is not None:
        if format not in READERS:
            raise ValueError(f"unknown rig format '{format}' (known: {', '.join(READERS)})")
        return READERS[format]
    head = path.read_bytes()[:4096].decode("utf-8", errors="replace") if path.is_file() else ""
    for module in READERS.values():
        if module.recognises(path, head):
            return module
    raise RigFileError(path, None, f"not a rig file of a known format ({', '.join(READERS)})")
