"""The error of every reader."""

from __future__ import annotations

from pathlib import Path


class RigFileError(ValueError):
    """A rig file that cannot be read: which file, which entry of it, and what to do, in one line."""

    def __init__(self, path: str | Path, entry: str | None, message: str) -> None:
        super().__init__(f"{path}: {entry}: {message}" if entry else f"{path}: {message}")
        self.path, self.entry = Path(path), entry
