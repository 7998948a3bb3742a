"""Many tasks on many machines: each leaves a file that appears whole, and is not repeated if that file is there.

In this process, in local processes, or on the workers of a Dask scheduler. A worker that is killed costs the tasks it
was at, which others repeat; a job that is killed as a whole is begun again and does only what is not there.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from distributed import Client

OnError = Literal["stop", "skip"]


class Task(NamedTuple):
    """Work that makes the file `makes` (and others before it); `run(*given)` must be fit to be pickled."""

    makes: Path
    run: Callable[..., None]
    given: tuple[object, ...] = ()


class Outcome(NamedTuple):
    """What became of a task: the error in one line, or nothing."""

    makes: Path
    error: str | None


@dataclass
class Report:
    """Files made, files that were there already, and the error of each task that failed."""

    made: list[Path] = field(default_factory=list)
    kept: list[Path] = field(default_factory=list)
    failed: dict[Path, str] = field(default_factory=dict)

    def __str__(self) -> str:
        parts = [f"{len(self.made)} made"]
        parts += [f"{len(self.kept)} there already"] if self.kept else []
        parts += [f"{len(self.failed)} failed"] if self.failed else []
        return ", ".join(parts)


class JobError(ValueError):
    """A task failed, and the job was to stop then."""


ENVIRONMENT = {"OMP_NUM_THREADS": 1, "MKL_NUM_THREADS": 1, "OPENBLAS_NUM_THREADS": 1}
"""Of local workers. Not Dask's own, which makes glibc return every freed image to the system at once: half of the
time of two workers then went into getting the same pages again."""


@contextmanager
def environment_put_back() -> Iterator[None]:
    """The environment is afterwards as it was: Dask leaves what it tells its workers in their parent too."""
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

    `scheduler` is the address of a Dask scheduler ("tcp://host:8786"); without, `count` processes on this machine, or
    this process itself for 1. `threads` are torch's in each: results are the same bits for the same number.
    """

    count: int = 1
    scheduler: str | None = None
    threads: int = 1

    @contextmanager
    def client(self) -> Iterator[Client]:
        """The Dask client; its local workers are gone afterwards. Raises ValueError if Dask is missing or not there."""
        try:
            from dask import config
            from distributed import Client, LocalCluster
        except ImportError:
            raise ValueError("several workers need Dask: pip install 'arraygeom-pat[cluster]'") from None
        if self.scheduler is None:
            options = {"n_workers": self.count, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
            with (
                environment_put_back(),
                config.set({"distributed.nanny.pre-spawn-environ": ENVIRONMENT}),
                LocalCluster(**options, memory_limit=0) as cluster,
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
) -> Report:
    """Run all tasks; with `resume`, only those whose file is not there. Without, such files are removed first.

    What goes wrong in a task (ValueError, OSError) is reported with its file's name and skipped, or stops the job: then
    JobError is raised, and what is made stays.
    """
    if not resume:
        for task in tasks:
            task.makes.unlink(missing_ok=True)
    kept = [t.makes for t in tasks if t.makes.exists()]
    report = Report(kept=kept)
    there = set(kept)
    left = [t for t in tasks if t.makes not in there]
    run = _in_this_process if workers.count == 1 and workers.scheduler is None else _on_dask
    with _bar(console) as bar:
        shown = bar.add_task(title, total=len(tasks), completed=len(kept))
        for outcome in run(left, workers):
            bar.advance(shown)
            if outcome.error is None:
                report.made.append(outcome.makes)
                continue
            report.failed[outcome.makes] = outcome.error
            if on_error == "stop":
                raise JobError(f"{outcome.makes.name}: {outcome.error} ({report}; begin again with --resume)")
            bar.console.print(f"skipped {outcome.makes.name}: {outcome.error}", style="yellow", markup=False)
    return report


def _bar(console: Console | None) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, TextColumn("left:"), TimeRemainingColumn(), console=console or Console(stderr=True))


def _in_this_process(tasks: Iterable[Task], workers: Workers) -> Iterator[Outcome]:
    before = torch.get_num_threads()
    try:
        for task in tasks:
            yield attempt(task, workers.threads)
    finally:
        torch.set_num_threads(before)


AHEAD = 4
"""Tasks handed to each worker before it is done with the first."""


def _on_dask(tasks: Sequence[Task], workers: Workers) -> Iterator[Outcome]:
    """Outcomes as they come. Dask repeats what a dead worker was at; what kills several is an outcome too."""
    if not tasks:
        return
    from distributed import as_completed

    with workers.client() as client:
        client.wait_for_workers(1, timeout=60)
        queue = iter(tasks)
        task_of = {}

        def submit(task: Task) -> object:
            future = client.submit(attempt, task, workers.threads, pure=False, retries=0)
            task_of[future.key] = task
            return future

        ahead = max(AHEAD * len(client.scheduler_info()["workers"]), 8)
        first = [submit(task) for _, task in zip(range(ahead), queue)]
        done = as_completed(first, with_results=False)
        for future in done:
            task = task_of.pop(future.key)
            outcome = future.result() if future.status == "finished" else Outcome(task.makes, _why(future))
            following = next(queue, None)
            if following is not None:
                done.add(submit(following))
            yield outcome


def _why(future: object) -> str:
    error = future.exception()  # type: ignore[attr-defined]
    return f"its workers died: {error}" if type(error).__name__ == "KilledWorker" else f"{error}"


def attempt(task: Task, threads: int) -> Outcome:
    """Run a task, unless a worker that died since has done it; errors of what was given become the outcome."""
    if task.makes.exists():
        return Outcome(task.makes, None)
    if torch.get_num_threads() != threads:
        torch.set_num_threads(threads)
    try:
        task.run(*task.given)
    except (ValueError, OSError) as error:
        return Outcome(task.makes, " ".join(str(error).split()))
    return Outcome(task.makes, None)


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
