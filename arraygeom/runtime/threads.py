"""Compiled loops on as many threads as torch may use, and torch's own loops kept out of their way.

A plain pool, for loops that release Python's lock: its idle threads sleep. Torch's spin while they wait,
unless `OMP_WAIT_POLICY=PASSIVE` was set before torch was loaded, and take the cores of the pool and of other
processes.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from typing import Any

import torch

from .tracing import followed

_ALLOWED: ContextVar[int | None] = ContextVar("threads", default=None)


def threads() -> int:
    """How many threads loops may take: as many as torch, or as it had before `torch_in_one_thread`."""
    return _ALLOWED.get() or torch.get_num_threads()


@contextmanager
def limited_to(count: int | None) -> Iterator[None]:
    """Let torch and loops take so many threads; None: as many as they may."""
    with _torch_threads(torch.get_num_threads() if count is None else count):
        yield


@contextmanager
def torch_in_one_thread() -> Iterator[None]:
    """Let torch's own loops run in the calling thread alone; `in_parallel` takes as many `threads` as before.

    For work that is mostly in compiled loops, beside which torch's own threads spin between short loops:
    without this a frame of 640x400 took twice the time of the cores where other processes wanted them.
    """
    allowed = _ALLOWED.set(threads())
    with _torch_threads(1):
        try:
            yield
        finally:
            _ALLOWED.reset(allowed)


def in_parallel(tasks: Sequence[Callable[[], Any]], *, most: int | None = None) -> list[Any]:
    """What tasks give, on as many `threads` as there are, or `most` of them, this one included; torch in each
    alone, with gradients and inference mode as here.

    After an error in one no other is begun; it is raised once those that were are at their end.
    """
    left, made = enumerate(tasks), [None] * len(tasks)

    def work() -> None:
        try:
            for i, task in left:
                made[i] = task()
        except BaseException:
            list(left)
            raise

    helpers = min(threads(), len(tasks), most or len(tasks)) - 1
    if helpers < 1:
        return [task() for task in tasks]
    work = _as_here(work)
    waiting = [_pool(os.getpid(), helpers).submit(work) for _ in range(helpers)]
    try:
        work()
    finally:
        wait(waiting)
    for future in waiting:
        future.result()
    return made


def in_order(function: Callable[[Any], Any], parts: Sequence[Any]) -> Iterator[Any]:
    """`map(function, parts)`, a few parts ahead on as many `threads` as there are; torch in each alone.

    A single part is computed in this thread, and so are all where torch itself takes several threads, or has
    to see each operation (`followed`, a function mode, autocast), which it does in one thread only. An error
    is raised once no part is computed any more.
    """
    if followed() or torch._C._len_torch_function_stack() or torch.is_autocast_enabled("cpu"):
        return map(function, parts)
    several = min(threads(), len(parts)) > 1 and torch.get_num_threads() == 1
    return _ahead(function, parts) if several else map(function, parts)


def _ahead(function: Callable[[Any], Any], parts: Sequence[Any]) -> Iterator[Any]:
    """`in_order` on several threads: at most as many parts ahead as there are threads."""
    count, work = threads(), _as_here(function)
    ahead: deque[Future[Any]] = deque()
    try:
        for argument in parts:
            ahead.append(_pool(os.getpid(), count).submit(work, argument))
            if len(ahead) > count:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
    finally:
        wait([future for future in ahead if not future.cancel()])


def _as_here(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function for other threads: torch in each alone, with gradients and inference mode as here."""
    graph, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def called(*args: Any) -> Any:
        with _torch_threads(1), torch.inference_mode(inference), torch.set_grad_enabled(graph):
            return function(*args)

    return called


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
