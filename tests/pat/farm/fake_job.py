"""A whole run without a renderer: `python fake_job.py ROOT SCENES WORKERS PAUSE`, to be killed at any moment."""

import json
import sys
from pathlib import Path

from pat.farm.folders import JobFolder, Shard
from pat.farm.pools import local_pool
from pat.farm.workshop import Order, RetryLimits

FAKE = Path(__file__).with_name("fake_worker.py")


def order(root: Path, behaviour: dict | None = None, tag: str = "1of1", **limits: float) -> Order:
    command = (sys.executable, str(FAKE), str(root), tag, json.dumps(behaviour or {}))
    return Order(root=root, tag=tag, command=command, limits=RetryLimits(**limits))


def main(root: str, scenes: str, workers: str, pause: str) -> None:
    folder, shard = JobFolder(Path(root)), Shard()
    with folder.locked(shard.tag):
        folder.clean(shard.tag)
        missing = [i for i in shard.of(int(scenes)) if not folder.is_done(i)]
        for _ in local_pool(order(folder.root, {"pause": float(pause)}), missing, int(workers)):
            pass


if __name__ == "__main__":
    main(*sys.argv[1:])
