"""Compiled loops on as many threads as torch may use, and torch's own loops kept out of their way.

A plain pool, for loops that release Python's lock: its idle threads sleep. Torch's spin while they wait, unless
`OMP_WAIT_POLICY=PASSIVE` was set before torch was loaded, and take the cores of the pool and of other processes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache

import torch

_ALLOWED: ContextVar[int | None] = ContextVar("threads", default=None)


def threads() -> int:
    """How many threads loops may take: as many as torch, or as it had before `torch_in_one_thread`."""
    return _ALLOWED.get() or torch.get_num_threads()


@contextmanager
def torch_in_one_thread() -> Iterator[None]:
    """Let torch's own loops run in the calling thread alone, while `in_parallel` takes as many `threads` as before.

    For work that is mostly in compiled loops, beside which torch's own threads spin between short loops: without this
    a frame of 640x400 took twice the time of the cores where other processes wanted them.
    """
    allowed = _ALLOWED.set(threads())
    with _torch_threads(1):
        try:
            yield
        finally:
            _ALLOWED.reset(allowed)


@contextmanager
def torch_in_all_threads() -> Iterator[None]:
    """Within `torch_in_one_thread`: let torch have all `threads`, for convolutions."""
    with _torch_threads(threads()):
        yield


def in_parallel(tasks: Sequence[Callable[[], object]], *, most: int | None = None) -> None:
    """Run tasks on as many `threads` as there are, or `most` of them, this one included; torch in each alone.

    After an error in one no other is begun; it is raised once those that were are at their end.
    """
    left = iter(tasks)

    def work() -> None:
        with _torch_threads(1):
            try:
                for task in left:
                    task()
            except BaseException:
                list(left)
                raise

    helpers = min(threads(), len(tasks), most or len(tasks)) - 1
    if helpers < 1:
        for task in left:
            task()
        return
    waiting = [_pool(os.getpid(), helpers).submit(work) for _ in range(helpers)]
    try:
        work()
    finally:
        wait(waiting)
    for future in waiting:
        future.result()


@contextmanager
def _torch_threads(count: int) -> Iterator[None]:
    """Torch has a number of threads for each thread that calls it, and that of the last call for new ones."""
    before = torch.get_num_threads()
    if before == count:
        yield
        return
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@lru_cache(maxsize=4)
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """Threads of this process: those of a parent do not live on in its forks."""
    return ThreadPoolExecutor(threads, thread_name_prefix="arraygeom")
