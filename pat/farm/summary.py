"""Summary of the folder of a job, in a few lines."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from pat.data.windows import scene_folders, scene_rig

from .folders import JobFolder
from .worker import FACTS


def summarise(root: Path) -> str:
    """Scenes, images, disk, time and memory, refusals, and abandoned scenes. Raises ValueError if there is none."""
    folders = scene_folders(root)
    rig = scene_rig(folders[0])
    size = sum(file.stat().st_size for folder in folders for file in folder.iterdir())
    sizes = ", ".join(f"{name} {c.hw[1]}x{c.hw[0]}" for name, c in rig.cameras.items())
    lines = [f"{len(folders)} scenes of {sizes}; {size / 1e6 / len(folders):.2f} MB each, {size / 1e9:.2f} GB in all"]
    facts = [json.loads((f / FACTS).read_text(encoding="utf-8")) for f in folders if (f / FACTS).is_file()]
    return "\n".join([*lines, *_of_the_making(facts), *_given_up(JobFolder(root))])


def _of_the_making(facts: Sequence[dict[str, Any]]) -> list[str]:
    if not facts:
        return []
    seconds, cpu = (median(f[key] for f in facts) for key in ("seconds", "cpu_seconds"))
    memory, refused = max(f["memory_mb"] for f in facts), sum(f["attempt"] for f in facts)
    return [
        f"a scene took {seconds:.1f} s, {cpu:.1f} s of a core (medians); workers had up to {memory:.0f} MB; "
        f"{refused} seeds were refused by the check"
    ]


def _given_up(folder: JobFolder) -> list[str]:
    reasons = {i: json.loads((folder.quarantined(i) / "reason.json").read_text()) for i in folder.given_up()}
    return [f"given up: scene {i}: {why['reason']}" for i, why in reasons.items()]
