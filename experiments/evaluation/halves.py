"""Stereo pairs in two halves: those on which settings may be chosen, and those that are reported."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

from arraygeom.safe_yaml import load_yaml
from pat.data.pairs import StereoPair


@cache
def tune_pairs() -> tuple[str, ...]:
    """Parts of the paths of pairs on which settings may be chosen (halves.yaml)."""
    return tuple(load_yaml(Path(__file__).with_name("halves.yaml").read_text(encoding="utf-8"))["tune"])


def of_half(pairs: Iterable[StereoPair], half: str) -> Iterator[StereoPair]:
    """The pairs of one half, "tune" or "report", or "all"."""
    for pair in pairs:
        tune = any(f"/{part}/" in f"/{pair.name}/" for part in tune_pairs())
        if half == "all" or tune == (half == "tune"):
            yield pair
