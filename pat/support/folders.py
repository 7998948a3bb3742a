"""Files of a folder and of those within it."""

from __future__ import annotations

import os
from pathlib import Path


def files_below(folder: str | Path, within: frozenset[str] = frozenset()) -> list[Path]:
    """All regular files in a folder and in those within it, behind symbolic links too, sorted.

    Links that lead back to a folder that they are `within` (real paths) are not followed. Folders that cannot
    be read hold nothing, as for `Path.rglob`.
    """
    real = os.path.realpath(folder)
    if real in within:
        return []
    try:
        entries = list(Path(folder).iterdir())
    except OSError:
        return []
    below = [file for path in entries if path.is_dir() for file in files_below(path, within | {real})]
    return sorted([path for path in entries if path.is_file()] + below)
