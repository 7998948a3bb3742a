"""Files of a folder and of those within it, and the suffixes of images and videos.

Only the standard library is imported: the command line needs them before torch.
"""

from __future__ import annotations

import os
from pathlib import Path

RAW_SUFFIXES = {".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".orf", ".rw2", ".pef"}
"""Of cameras' raw files."""
PHOTO_SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".ppm"}
"""Of photographs among other files: .pgm are masks and disparities as often."""
IMAGE_SUFFIXES = PHOTO_SUFFIXES | RAW_SUFFIXES | {".pgm", ".pnm", ".heic", ".heif"}
VIDEO_SUFFIXES = {".mp4", ".mkv", ".mov", ".avi", ".m4v", ".webm"}


def files_below(folder: str | Path, within: frozenset[str] = frozenset()) -> list[Path]:
    """All regular files in a folder and in those within it, behind symbolic links too, sorted.

    Links that lead back to a folder that they are `within` (real paths) are not followed. Folders that cannot be read
    hold nothing, as for `Path.rglob`.
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
