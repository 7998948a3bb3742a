"""Threads for compiled loops, as many as torch may use, with torch's own loops kept out of their way.

A plain pool serves loops that release Python's lock: its idle threads sleep. Torch's threads spin while they
wait, unless `OMP_WAIT_POLICY=PASSIVE` was set before torch was loaded, and take the cores of the pool and of
other processes.
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
    """Return the number of threads that loops may use: torch's, or torch's before `torch_in_one_thread`."""
    return _ALLOWED.get() or torch.get_num_threads()


@contextmanager
def limited_to(count: int | None) -> Iterator[None]:
    """Context manager that limits torch and loops to `count` threads; None keeps the number."""
    with _torch_threads(torch.get_num_threads() if count is None else count):
        yield


@contextmanager
def torch_in_one_thread() -> Iterator[None]:
    """Context manager that sets torch to one thread, while `in_parallel`, `in_order` and compiled loops may
    still use as many as torch had before.

    For work that is mostly in compiled loops, beside which torch's own threads spin between short loops.
    """
    allowed = _ALLOWED.set(threads())
    with _torch_threads(1):
        try:
            yield
        finally:
            _ALLOWED.reset(allowed)


def in_parallel(tasks: Sequence[Callable[[], Any]], *, most: int | None = None) -> list[Any]:
    """Run tasks on several threads, this one included, with torch in one thread each, gradients and inference
    mode as here.

    A single task, or all where one thread is allowed, run here with torch's threads as they are. After an
    error no further task begins; it is raised once the running ones have ended.

    Args:
        tasks: functions without arguments.
        most: largest number of threads; None or 0 for as many as `threads` gives.

    Returns:
        The tasks' results, in order.
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
    """Compute `map(function, parts)` some parts ahead on several `threads`, with torch in one thread each.

    A single part is computed in this thread, when its turn comes, and so are all if one thread is allowed,
    torch itself uses several, or it has to see each operation (`followed`, a function mode, autocast). A
    part's error is raised at its place in the iterator, once no part is being computed.

    Args:
        function: function of one part.
        parts: arguments to call it with.

    Returns:
        Iterator over the results, in order.
    """
    if followed() or torch._C._len_torch_function_stack() or torch.is_autocast_enabled("cpu"):
        return map(function, parts)
    several = min(threads(), len(parts)) > 1 and torch.get_num_threads() == 1
    return _ahead(function, parts) if several else map(function, parts)


def _ahead(function: Callable[[Any], Any], parts: Sequence[Any]) -> Iterator[Any]:
    """Run `in_order` on several threads, at most as many parts ahead as there are threads."""
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
    """Wrap a function for other threads: torch in one thread, gradients and inference mode as here."""
    graph, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def called(*args: Any) -> Any:
        with _torch_threads(1), torch.inference_mode(inference), torch.set_grad_enabled(graph):
            return function(*args)

    return called


@contextmanager
def _torch_threads(count: int) -> Iterator[None]:
    """Set torch's number of threads for this thread; torch uses that of the last call for new threads."""
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
    """Thread pool of this process: a parent's threads do not survive in its forks."""
    return ThreadPoolExecutor(threads, thread_name_prefix="arraygeom")
