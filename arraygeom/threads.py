"""Compiled loops on as many threads as torch may use.

A plain pool, for loops that release Python's lock: idle threads sleep, so that they do not take the cores from
torch's own.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache

import torch


def in_parallel(tasks: Sequence[Callable[[], object]], *, most: int | None = None) -> None:
    """Run tasks on the threads that torch may use, or `most` of them, this one included.

    After an error in one no other is begun; it is raised once those that were are at their end.
    """
    left = iter(tasks)

    def work() -> None:
        try:
            for task in left:
                task()
        except BaseException:
            list(left)
            raise

    helpers = min(torch.get_num_threads(), len(tasks), most or len(tasks)) - 1
    waiting = [_pool(os.getpid(), helpers).submit(work) for _ in range(helpers)]
    try:
        work()
    finally:
        wait(waiting)
    for future in waiting:
        future.result()


@lru_cache(maxsize=4)
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """Threads of this process: those of a parent do not live on in its forks."""
    return ThreadPoolExecutor(threads, thread_name_prefix="arraygeom")
