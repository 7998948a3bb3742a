"""What the journals of a job say."""

import json
from pathlib import Path


def events(root: Path) -> list[dict]:
    """All that happened, in order of time."""
    lines = [line for file in (root / ".work" / "journal").glob("*.jsonl") for line in file.read_text().splitlines()]
    return sorted((json.loads(line) for line in lines), key=lambda e: e["time"])


def started_after_done(root: Path) -> list[int]:
    """Scenes that someone began to make when they were done."""
    done, found = set(), []
    for event in events(root):
        if event["event"] == "start" and event["scene"] in done:
            found.append(event["scene"])
        if event["event"] == "done":
            done.add(event["scene"])
    return found
