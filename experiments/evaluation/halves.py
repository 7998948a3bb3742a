"""Stereo pairs in two halves: those on which settings may be chosen, and those that are reported."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from arraygeom.runtime.safe_yaml import load_yaml
from pat.lab.data.pairs import StereoPair


def of_half(pairs: Iterable[StereoPair], half: str) -> Iterator[StereoPair]:
    """The pairs of one half, "tune" (parts of their paths are in halves.yaml) or "report", or "all"."""
    listed = load_yaml(Path(__file__).with_name("halves.yaml").read_text(encoding="utf-8"))["tune"]
    for pair in pairs:
        tune = any(f"/{folder}/" in f"/{pair.name}/" for folder in listed)
        if half == "all" or tune == (half == "tune"):
            yield pair
