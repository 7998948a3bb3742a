"""Many tasks on many machines: each writes a file atomically, and is not repeated if that file is there.

In this process, in local processes, or on the workers of a Dask scheduler. If a worker is killed, others repeat the
tasks it was running; a job that is killed as a whole and started again does only what is missing. Torch is imported
only where tasks run.
"""

from __future__ import annotations

import math
import os
import re
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from .steps import about, steps_shown

if TYPE_CHECKING:
    from distributed import Client, Future, LocalCluster

T = TypeVar("T")
OnError = Literal["stop", "skip"]


class Task(NamedTuple):
    """Work that writes the file `makes` (and others before it); `run(*given)` must be fit to be pickled.

    Messages name `about`, or else the file that is made.
    """

    makes: Path
    run: Callable[..., None]
    given: tuple[object, ...] = ()
    about: str = ""


class TaskOutcome(NamedTuple):
    """The error of a task in one line, or None; its warnings, the last of them the error if a filter made it so."""

    makes: Path
    error: str | None
    warnings: tuple[Warning, ...] = ()


@dataclass
class JobReport:
    """Files made, files that were there already, the error of each task that failed, and who warned of what."""

    made: list[Path] = field(default_factory=list)
    kept: list[Path] = field(default_factory=list)
    failed: dict[Path, str] = field(default_factory=dict)
    warned: dict[str, list[Path]] = field(default_factory=dict)

    def warn(self, outcome: TaskOutcome, about: str) -> None:
        """Pass on the warnings of a task, one of each kind: texts that differ in numbers alone are of one kind."""
        for warning in outcome.warnings:
            kind = re.sub(r"[\d.]+", "", f"{type(warning).__name__}: {warning}")
            files = self.warned.setdefault(kind, [])
            if not files:
                warnings.warn(f"{about}: {warning}", type(warning), stacklevel=3)
            if outcome.makes not in files:
                files.append(outcome.makes)

    def __str__(self) -> str:
        warned = {file for files in self.warned.values() for file in files}
        further = {"there already": self.kept, "failed": self.failed, "with warnings": warned}
        return ", ".join([f"{len(self.made)} made", *(f"{len(n)} {what}" for what, n in further.items() if n)])


class JobError(ValueError):
    """A job cannot or must not go on; what is made stays."""


ENVIRONMENT = {"OMP_NUM_THREADS": 1, "MKL_NUM_THREADS": 1, "OPENBLAS_NUM_THREADS": 1}
"""Of local workers. Not Dask's own, which makes glibc return every freed image to the system at once: half of the
time of two workers was then spent on getting the same pages again."""


@contextmanager
def environment_restored() -> Iterator[None]:
    """Restore the environment afterwards: Dask sets the variables of its workers in their parent too."""
    before = dict(os.environ)
    try:
        yield
    finally:
        for name in os.environ.keys() - before.keys():
            del os.environ[name]
        os.environ.update(before)


@dataclass(frozen=True)
class Workers:
    """Where tasks run.

    `scheduler` is the address of a Dask scheduler ("tcp://host:8786"), or "local" for one on this machine with `count`
    processes; without, `count` processes on this machine, or this process itself for 1. `threads` are torch's in each:
    results are identical to the bit for the same number.
    """

    count: int = 1
    scheduler: str | None = None
    threads: int = 1

    @contextmanager
    def client(self) -> Iterator[Client]:
        """The Dask client; its local workers are gone afterwards. Raises ValueError without Dask or scheduler."""
        try:
            from dask import config
            from distributed import Client, LocalCluster
        except ImportError:
            raise ValueError("several workers need Dask: pip install 'arraygeom-pat[cluster]'") from None
        if self.scheduler in (None, "local"):
            options = {"n_workers": self.count, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
            with (
                environment_restored(),
                config.set({"distributed.nanny.pre-spawn-environ": ENVIRONMENT}),
                _started(lambda: LocalCluster(**options, memory_limit=0)) as cluster,
                Client(cluster) as client,
            ):
                yield client
        else:
            try:
                client = Client(self.scheduler, timeout=20)
            except (OSError, ValueError) as error:
                raise ValueError(f"no Dask scheduler at {self.scheduler}: {error}") from None
            with client:
                yield client


def _started(cluster: Callable[[], LocalCluster]) -> LocalCluster:
    """A cluster, once its workers run. Raises ValueError if one of them died at its start."""
    try:
        return cluster()
    except RuntimeError as error:
        raise ValueError(f"a worker died while it started ({error}): give the same command again") from None


HERE = Workers()
"""This process, one thread."""


def run_tasks(
    tasks: Sequence[Task],
    *,
    workers: Workers = HERE,
    resume: bool = False,
    on_error: OnError = "stop",
    title: str = "working",
    console: Console | None = None,
) -> JobReport:
    """Run all tasks; with `resume`, only those whose file is missing. Without, such files are removed first.

    An error of a task (ValueError, OSError) is reported with its file's name and the task skipped, or it stops the
    job: then JobError is raised, and what is made stays.
    """
    if not resume:
        for task in tasks:
            task.makes.unlink(missing_ok=True)
    report = JobReport(kept=[t.makes for t in tasks if t.makes.exists()])
    there = set(report.kept)
    named = {t.makes: t.about or t.makes.name for t in tasks}
    left = [t for t in tasks if t.makes not in there]
    console = console or Console(stderr=True)
    run = _in_this_process if workers.count == 1 and workers.scheduler is None else _on_dask
    for outcome in followed(run(left, workers), title=title, total=len(tasks), done=len(there), console=console):
        if outcome.error is None:
            report.made.append(outcome.makes)
            report.warn(outcome, named[outcome.makes])
            continue
        report.failed[outcome.makes] = outcome.error
        if on_error == "stop":
            text = f"{named[outcome.makes]}: {outcome.error} ({report}; begin again with --resume)"
            raise JobError(text) from next(iter(outcome.warnings[::-1]), None)
        console.print(f"skipped {named[outcome.makes]}: {outcome.error}", style="yellow", markup=False)
    return report


LINE_EVERY = 30.0
"""Seconds between lines of progress where there is no terminal."""


def followed(
    outcomes: Iterable[T],
    *,
    title: str,
    total: int,
    done: int = 0,
    console: Console,
    status: Callable[[T], str] = lambda _: "",
) -> Iterator[T]:
    """The outcomes as they come, their number shown: as a bar on a terminal, elsewhere as a line now and then.

    `status` counts an outcome and returns what else to show.
    """
    printed = time.monotonic()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    further = (TimeRemainingColumn(), TextColumn("{task.fields[status]}"))
    hidden = not console.is_terminal
    with Progress(*columns, *further, console=console, disable=hidden, speed_estimate_period=math.inf) as bar:
        shown = bar.add_task(title, total=total, completed=done, status="")
        with steps_shown(lambda step: bar.update(shown, status=step)):
            for outcome in outcomes:
                done += 1
                text = status(outcome)
                bar.update(shown, completed=done, status=text)
                if hidden and time.monotonic() - printed > LINE_EVERY:
                    printed = time.monotonic()
                    seconds = bar.tasks[0].time_remaining
                    left = f", {about(seconds)}" if seconds else ""
                    line = f"{title}: {done} of {total}{left}" + f": {text}" * bool(text)
                    console.print(line, soft_wrap=True, highlight=False, markup=False)
                yield outcome


def _in_this_process(tasks: Iterable[Task], workers: Workers) -> Iterator[TaskOutcome]:
    import torch

    before = torch.get_num_threads()
    try:
        for task in tasks:
            yield attempt(task, workers.threads)
    finally:
        torch.set_num_threads(before)


def _on_dask(tasks: Sequence[Task], workers: Workers) -> Iterator[TaskOutcome]:
    """Outcomes as they come; a task that kills its workers is an outcome too."""
    for task, future in completed(attempt_on_worker, [(task, workers.threads) for task in tasks], workers):
        yield future.result() if future.status == "finished" else TaskOutcome(task[0].makes, why(future))


AHEAD = 4
"""Tasks submitted for each worker at once, so that none of them waits for the next."""


def completed(
    run: Callable[..., object], items: Sequence[tuple[Any, ...]], workers: Workers
) -> Iterator[tuple[tuple[Any, ...], Future]]:
    """`run(*item)` of all items on Dask: each item with its future, as they complete.

    Dask repeats what a dead worker was running; what kills several workers completes with an error (see `why`).
    """
    if not items:
        return
    with workers.client() as client:
        from distributed import as_completed

        client.wait_for_workers(1, timeout=60)
        queue = iter(items)
        running = {}

        def submit(item: tuple[Any, ...]) -> Future:
            future = client.submit(run, *item, pure=False, retries=0)
            running[future.key] = future, item
            return future

        ahead = max(AHEAD * len(client.scheduler_info()["workers"]), 8)
        done = as_completed([submit(item) for _, item in zip(range(ahead), queue)], with_results=False)
        try:
            for future in done:
                _, item = running.pop(future.key)
                following = next(queue, None)
                if following is not None:
                    done.add(submit(following))
                yield item, future
        finally:
            client.cancel([future for future, _ in running.values()])


def why(future: Future) -> str:
    """Why a future has no result."""
    error = future.exception()
    return f"its workers died: {error}" if type(error).__name__ == "KilledWorker" else f"{error}"


def attempt(task: Task, threads: int) -> TaskOutcome:
    """Run a task, unless a worker that died since has done it; errors of what was given become the outcome."""
    import torch

    if task.makes.exists():
        return TaskOutcome(task.makes, None)
    if torch.get_num_threads() != threads:
        torch.set_num_threads(threads)
    error, raised = None, []
    with warnings.catch_warnings(record=True) as caught:
        try:
            task.run(*task.given)
        except (ValueError, OSError) as failure:
            error = " ".join(str(failure).split())
        except Warning as failure:
            error, raised = f"{failure}", [failure]
    given = [entry.message for entry in caught if isinstance(entry.message, Warning)]
    return TaskOutcome(task.makes, error, (*given, *raised))


def attempt_on_worker(task: Task, threads: int) -> TaskOutcome:
    """`attempt` in a process of Dask's, which does nothing else."""
    from .memory import keep_freed

    keep_freed()
    return attempt(task, threads)


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
