"""Image files of cameras matched to frames: by their names, numbers or times in these, or in order.

A camera that missed a frame would otherwise shift all that follow.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterable, Mapping, Sequence
from itertools import pairwise, takewhile
from pathlib import Path
from statistics import median

from arraygeom.runtime.warned import warn

LEAST_WHOLE = 0.5
"""Least share of all frames that every camera must have: of fewer, names agree by chance, as those of a
sequence may."""
LISTED = 5
"""Number of names of missing frames in a message."""

Files = Mapping[str, Sequence[Path]]
Keys = dict[str, list[Hashable]]
"""Keys of files' frames, by camera, in the order of the files."""


class MissingFramesWarning(UserWarning):
    """Warning of frames that some camera lacks, or that no name relates."""


def matched_frames(files: Files) -> dict[str, list[Path]]:
    """Relate the files of several cameras by the names and numbers in them, frame by frame.

    Names count if no camera repeats one and half of all frames or more are then whole, else numbers, or
    else names without their common beginning. Warns of frames that some camera lacks, and of taking files in
    order, as nothing relates them.

    Args:
        files: files of each camera, in order.

    Returns:
        Files of the frames that every camera has, in order, by camera; all as given if one has under two.

    Raises:
        ValueError: if nothing relates the files and their numbers differ, and without cameras.
    """
    files_of = {name: list(paths) for name, paths in files.items()}
    if min(map(len, files_of.values())) < 2:
        return files_of
    for what, keys in (("names", _names(files)), ("numbers", _numbers(files)), ("names", _endings(files))):
        frames = _frames(files_of, keys) if keys and all(len({*k}) == len(k) for k in keys.values()) else []
        whole = [frame for frame in frames if len(frame) == len(files_of)]
        if len(whole) >= LEAST_WHOLE * len(frames) > 0:
            _warn_of_missing(files_of, frames, what)
            return {name: [frame[name] for frame in whole] for name in files_of}
    spans = ", ".join(f"'{name}' {paths[0].name} to {paths[-1].name}" for name, paths in files_of.items())
    if len({len(paths) for paths in files_of.values()}) > 1:
        counts = ", ".join(f"{len(paths)} of '{name}'" for name, paths in files_of.items())
        raise ValueError(
            f"frames need as many images of each camera, got {counts}; or is it for `pat sequence`?"
        )
    warn(f"no name or number relates the frames ({spans}): taken in order", MissingFramesWarning)
    return files_of


def warn_of_gaps(files: Files) -> None:
    """Warn of the first gap in the numbers of each camera's files: a sequence has frames equally far apart.

    There is no warning for any camera if names of one lack numbers, repeat them, or have several that vary.

    Args:
        files: files of each camera, in order.
    """
    for name, numbers in (_numbers(files) or {}).items():
        counted = [n for n in numbers if isinstance(n, float)]
        steps = [b - a for a, b in pairwise(counted)] if len(counted) == len(numbers) else []
        gaps = [i for i, step in enumerate(steps) if step > 1.5 * median(steps)]
        if gaps:
            before, after = files[name][gaps[0]].name, files[name][gaps[0] + 1].name
            text = (
                f"'{name}' has no frame between {before} and {after}: "
                "those after it count as recorded earlier"
            )
            warn(f"{text} than they were; give all frames", MissingFramesWarning)


def _frames(files: Mapping[str, Sequence[Path]], keys: Keys) -> list[dict[str, Path]]:
    """Return the files of each frame by camera, in the order of the keys."""
    frames: dict[Hashable, dict[str, Path]] = {}
    for name, paths in files.items():
        for key, path in zip(keys[name], paths):
            frames.setdefault(key, {})[name] = path
    order: Iterable[Hashable] = frames
    if all(isinstance(key, float | tuple) for key in frames):
        order = sorted(frames)  # type: ignore[type-var]
    return [frames[key] for key in order]


def _warn_of_missing(files: Files, frames: Sequence[Mapping[str, Path]], what: str) -> None:
    missing = []
    for name in files:
        lacking = [min(frame.values()).stem for frame in frames if name not in frame]
        if lacking:
            more = f" and {len(lacking) - LISTED} more" if len(lacking) > LISTED else ""
            missing.append(f"'{name}' has none of {', '.join(lacking[:LISTED])}{more}")
    if missing:
        whole = sum(len(frame) == len(files) for frame in frames)
        text = f"frames are matched by their {what}: {'; '.join(missing)}: {whole} of {len(frames)} are taken"
        warn(text, MissingFramesWarning)


def _names(files: Files) -> Keys:
    return {name: [path.stem for path in paths] for name, paths in files.items()}


def _endings(files: Files) -> Keys | None:
    """Return names without their common beginning, by camera."""
    keys: Keys = {}
    for name, paths in files.items():
        columns = zip(*(path.stem for path in paths))
        shared = sum(1 for _ in takewhile(lambda letters: len(set(letters)) == 1, columns))
        keys[name] = [path.stem[shared:] for path in paths]
    return keys


def _numbers(files: Files) -> Keys | None:
    """Return numbers in names that differ between a camera's files; single ones that nearly agree as equal.

    None where two files of a camera have the same, or some have other numbers of numbers.
    """
    varying: dict[str, list[tuple[float, ...]]] = {}
    for name, paths in files.items():
        rows = [tuple(map(float, re.findall(r"\d+(?:\.\d+)?", path.stem))) for path in paths]
        if len({len(row) for row in rows}) != 1 or len(set(rows)) < len(rows):
            return None
        columns = [column for column in zip(*rows) if len(set(column)) > 1 or len(rows) == 1]
        varying[name] = list(zip(*columns))
    if {len(row) for rows in varying.values() for row in rows} != {1}:
        return {name: list(rows) for name, rows in varying.items()}
    return _common_times({name: [row[0] for row in rows] for name, rows in varying.items()})


def _common_times(times: Mapping[str, Sequence[float]]) -> Keys:
    """Return each time as the first of those of other cameras that are less than half an interval from it."""
    intervals = [median(b - a for a, b in pairwise(sorted(row))) for row in times.values() if len(row) > 1]
    near = min(intervals, default=float("inf")) / 2
    common: dict[tuple[str, float], float] = {}
    first, here = -float("inf"), set[str]()
    for time, name in sorted((time, name) for name, row in times.items() for time in row):
        if time - first >= near or name in here:
            first, here = time, set()
        here.add(name)
        common[name, time] = first
    return {name: [common[name, time] for time in row] for name, row in times.items()}
