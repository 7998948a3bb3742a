"""Jobs of many tasks in many processes; each task writes one file or folder and is skipped if that exists.

Tasks run in this process, in other processes on this machine, or on the workers of a Dask scheduler. A task
whose process is killed is repeated by another; a job that is killed and started again does only what is
missing. Torch is imported only where tasks run.
"""

from __future__ import annotations

import faulthandler
import math
import os
import re
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from arraygeom.runtime.extras import needs
from arraygeom.runtime.warned import warn

from .folders import error_text, printable
from .steps import about, steps_shown

if TYPE_CHECKING:
    from distributed import Future

T = TypeVar("T")
OnError = Literal["stop", "skip"]


class Task(NamedTuple):
    """One unit of work of a job.

    Attributes:
        makes: file or folder that the task writes last, of no other task; once it exists the task counts as
            done.
        run: function, called as `run(*given)`; for other processes both must be picklable.
        given: arguments of `run`.
        about: name in messages; empty for the name of `makes`.
    """

    makes: Path
    run: Callable[..., None]
    given: tuple[object, ...] = ()
    about: str = ""


class TaskOutcome(NamedTuple):
    """Result of one task.

    Attributes:
        makes: file or folder of the task.
        error: message of the error that ended the task; None for success, and if `makes` existed.
        warnings: warnings raised; the last one is the error itself where a filter turned a warning into it.
    """

    makes: Path
    error: str | None
    warnings: tuple[Warning, ...] = ()


@dataclass
class JobReport:
    """Result of a job.

    Attributes:
        made: files or folders of the tasks that succeeded in this run, as they finished.
        kept: those that existed before, whose tasks did not run.
        failed: error message by the file of the failed task.
        warned: files in `made` whose tasks warned, by kind of warning: its class and text without digits and
            dots.
    """

    made: list[Path] = field(default_factory=list)
    kept: list[Path] = field(default_factory=list)
    failed: dict[Path, str] = field(default_factory=dict)
    warned: dict[str, list[Path]] = field(default_factory=dict)

    def warn(self, outcome: TaskOutcome, about: str) -> None:
        """Repeat a task's warnings in this process, the first of each kind in the job. Updates `warned`.

        Args:
            outcome: outcome of the task.
            about: name of the task, put before the warning.

        Raises:
            Warning: the warning itself, where a filter of this process makes it an error.
        """
        for warning in outcome.warnings:
            kind = re.sub(r"[\d.]+", "", f"{type(warning).__name__}: {warning}")
            files = self.warned.setdefault(kind, [])
            if not files:
                warn(f"{about}: {warning}", type(warning))
            if outcome.makes not in files:
                files.append(outcome.makes)

    def __str__(self) -> str:
        warned = {file for files in self.warned.values() for file in files}
        further = {"there already": self.kept, "failed": self.failed, "with warnings": warned}
        return ", ".join([f"{len(self.made)} made", *(f"{len(n)} {w}" for w, n in further.items() if n)])


class JobError(ValueError):
    """Error that stops a job; finished files stay."""


@dataclass(frozen=True)
class Workers:
    """Processes that tasks run in.

    Attributes:
        count: processes on this machine; 1 runs tasks in this process unless `apart`.
        scheduler: address of a Dask scheduler ("tcp://host:8786"), whose workers then run the tasks, whatever
            `count`, `apart` and `timeout` are; None for this machine.
        threads: torch's threads in each process; another number may change results in their last bits.
        apart: True for a separate process even with `count` 1, for tasks that may crash or hang.
        timeout: seconds, above 0, that each of `TRIES` attempts may take in a separate process; None for no
            limit. A task in this process has none.

    Raises:
        ValueError: for a `count` or `threads` below 1, and a `timeout` of 0 or less, or without end.
    """

    count: int = 1
    scheduler: str | None = None
    threads: int = 1
    apart: bool = False
    timeout: float | None = None

    def __post_init__(self) -> None:
        if self.count < 1 or self.threads < 1:
            raise ValueError(f"{self.count} processes of {self.threads} threads: give 1 or more of each")
        if self.timeout is not None and not 0 < self.timeout <= threading.TIMEOUT_MAX:
            raise ValueError(f"timeout is {self.timeout} seconds: give more than 0, or None for no limit")


HERE = Workers()
"""This process with one thread."""


def run_tasks(
    tasks: Sequence[Task],
    *,
    workers: Workers = HERE,
    resume: bool = False,
    on_error: OnError = "stop",
    title: str = "working",
    console: Console | None = None,
) -> JobReport:
    """Run the tasks of a job and report what each became.

    Args:
        workers: processes to run them in; by default this one.
        resume: True to skip tasks whose file or folder exists; otherwise their files are deleted first.
        on_error: "stop" raises at the first task that fails; "skip" prints its error and goes on. A task
            fails by a ValueError, OSError or Warning; in another process by any error, its end or `timeout`.
        title: word before the progress bar.
        console: console for progress and messages; None for standard error.

    Returns:
        Files made, kept and failed, and the warnings.

    Raises:
        JobError: for a failed task with on_error="stop", and for a task's own JobError always; finished files
            stay.
        OSError: without `resume`, for a folder in the way, or a file that cannot be deleted.
        ImportError: for a scheduler where Dask is not installed.
        ValueError: if no scheduler answers.
        TimeoutError: if it has no worker within a minute.
        Warning: a task's in another process, where a filter of this one makes it an error.
        Exception: another error of a task in this process, and of pickling for others, as it is.
    """
    if not resume:
        for task in tasks:
            task.makes.unlink(missing_ok=True)
    report = JobReport(kept=[t.makes for t in tasks if t.makes.exists()])
    there = set(report.kept)
    named = {t.makes: t.about or t.makes.name for t in tasks}
    left = [t for t in tasks if t.makes not in there]
    console = console or Console(stderr=True)
    here = workers.count == 1 and not workers.apart
    run = _on_dask if workers.scheduler else _in_this_process if here else _in_processes
    made = run(left, workers)
    for outcome in followed(made, title=title, total=len(tasks), done=len(there), console=console):
        if outcome.error is None:
            report.made.append(outcome.makes)
            report.warn(outcome, named[outcome.makes])
            continue
        report.failed[outcome.makes] = outcome.error
        if on_error == "stop":
            text = f"{named[outcome.makes]}: {outcome.error} ({report}; begin again with --resume)"
            raise JobError(text) from next(iter(outcome.warnings[::-1]), None)
        skipped = printable(f"skipped {named[outcome.makes]}: {outcome.error}")
        console.print(skipped, style="yellow", markup=False)
    return report


LINE_EVERY = 30.0
"""Seconds between lines of progress without a terminal."""


def followed(outcomes: Iterable[T], *, title: str, total: int, done: int, console: Console) -> Iterator[T]:
    """Show the progress of outcomes while they are consumed: a bar on a terminal, else a line with an
    outcome when `LINE_EVERY` seconds have passed since the last.

    Args:
        title: word before the bar, or in the line.
        total: number of tasks, those done before included.
        done: number of tasks done before.

    Yields:
        Each outcome, unchanged.
    """
    printed = time.monotonic()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    further = (TimeRemainingColumn(), TextColumn("{task.fields[status]}", markup=False))
    hidden = not console.is_terminal
    with Progress(*columns, *further, console=console, disable=hidden, speed_estimate_period=math.inf) as bar:
        shown = bar.add_task(title, total=total, completed=done, status="")
        with steps_shown(lambda step: bar.update(shown, status=step)):
            for outcome in outcomes:
                done += 1
                bar.update(shown, completed=done, status="")
                if hidden and time.monotonic() - printed > LINE_EVERY:
                    printed = time.monotonic()
                    seconds = bar.tasks[0].time_remaining
                    line = f"{title}: {done} of {total}" + (f", {about(seconds)}" if seconds else "")
                    console.print(line, soft_wrap=True, highlight=False, markup=False)
                yield outcome


def _in_this_process(tasks: Iterable[Task], workers: Workers) -> Iterator[TaskOutcome]:
    from arraygeom.runtime.threads import limited_to

    for task in tasks:
        with limited_to(workers.threads):  # not to this generator's end: a failed job's traceback keeps it
            outcome = attempt(task, workers.threads)
        yield outcome


ENVIRONMENT = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Environment variables of processes on this machine."""
TRIES = 3
"""Attempts at a task whose process dies or takes too long."""


def _in_processes(tasks: Sequence[Task], workers: Workers) -> Iterator[TaskOutcome]:
    """Yield outcomes as they arrive. A thread waits for each process, to know the task with which it dies."""
    slots, before, others = threading.local(), dict(os.environ), {*active_children()}
    ended: list[JobError] = []

    def made(task: Task) -> TaskOutcome:
        error = ""
        for _ in range(TRIES):
            if ended:  # threads may come to many tasks before the job's own thread hears of it
                raise ended[0]
            if not hasattr(slots, "process"):
                slots.process = ProcessPoolExecutor(1, get_context("spawn"), initializer=_begin)
            begin = time.monotonic()
            try:
                arguments = task, workers.threads, workers.timeout
                return slots.process.submit(attempt_on_worker, *arguments).result()
            except BrokenProcessPool:
                del slots.process
                long = workers.timeout is not None and time.monotonic() - begin >= workers.timeout
                error = f"took longer than {workers.timeout:g} s" if long else "its process died"
            except JobError as failure:
                ended.append(failure)
                raise
        return TaskOutcome(task.makes, error)

    os.environ.update(ENVIRONMENT)
    threads = ThreadPoolExecutor(workers.count)
    try:
        for future in as_completed([threads.submit(made, task) for task in tasks]):
            yield future.result()
    finally:
        ended.append(JobError("the job has ended"))
        threads.shutdown(wait=False, cancel_futures=True)
        for process in {*active_children()} - others:
            process.kill()
            process.join()
        for name in ENVIRONMENT.keys() - before.keys():
            del os.environ[name]
        os.environ.update(before)


def _begin() -> None:
    """Prepare a worker process: it ignores interrupts, which its parent handles, and ends with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    if (parent := parent_process()) is not None:
        parent.join()
        os._exit(1)


AHEAD = 4
"""Tasks submitted for each Dask worker at once, so that none of them waits for the next."""


def _on_dask(tasks: Sequence[Task], workers: Workers) -> Iterator[TaskOutcome]:
    """Yield outcomes as they arrive. Dask repeats dead workers' tasks; a task that kills several fails."""
    if not tasks:
        return
    with needs("cluster", "a scheduler"):
        from distributed import Client, as_completed
    try:
        client = Client(workers.scheduler, timeout=20)
    except (OSError, ValueError) as error:
        raise ValueError(f"no Dask scheduler at {workers.scheduler}: {error}") from None
    with client:
        client.wait_for_workers(1, timeout=60)
        queue = iter(tasks)
        running = {}

        def submit(task: Task) -> Future:
            future = client.submit(attempt_on_worker, task, workers.threads, pure=False, retries=0)
            running[future.key] = future, task
            return future

        ahead = max(AHEAD * len(client.scheduler_info()["workers"]), 8)
        completed = as_completed([submit(task) for _, task in zip(range(ahead), queue)], with_results=False)
        try:
            for future in completed:
                _, task = running.pop(future.key)
                following = next(queue, None)
                if following is not None:
                    completed.add(submit(following))
                yield future.result() if future.status == "finished" else _failed(task, future)
        finally:
            client.cancel([future for future, _ in running.values()])


def _failed(task: Task, future: Future) -> TaskOutcome:
    """The outcome of a task without a result. Raises the task's own JobError."""
    error = future.exception()
    if isinstance(error, JobError):
        raise error
    died = type(error).__name__ == "KilledWorker"
    return TaskOutcome(task.makes, f"its workers died: {error}" if died else f"{error}")


def attempt(task: Task, threads: int) -> TaskOutcome:
    """Run a task in this process unless its file or folder exists; catch ValueError, OSError and Warning.

    Args:
        threads: torch's number of threads, which stays set for the whole process.

    Returns:
        The outcome, with the warnings that were raised; a success without any if the file existed.

    Raises:
        JobError: the task's own, for errors that every task would have.
        Exception: another error of the task than those caught.
    """
    import torch

    if task.makes.exists():
        return TaskOutcome(task.makes, None)
    if torch.get_num_threads() != threads:
        torch.set_num_threads(threads)
    error, raised = None, []
    with warnings.catch_warnings(record=True) as caught:
        try:
            task.run(*task.given)
        except JobError:
            raise
        except (ValueError, OSError) as failure:
            error = error_text(failure)
        except Warning as failure:
            error, raised = f"{failure}", [failure]
    caught_warnings = [entry.message for entry in caught if isinstance(entry.message, Warning)]
    return TaskOutcome(task.makes, error, (*caught_warnings, *raised))


def attempt_on_worker(task: Task, threads: int, timeout: float | None = None) -> TaskOutcome:
    """Run `attempt` in a process that does nothing else, and keep its freed memory for later tasks.

    Args:
        threads: torch's number of threads in this process.
        timeout: seconds after which the process ends itself, with exit status 1; None for no limit.

    Returns:
        The outcome; any other error than JobError becomes one too, "TypeError: ..." for a TypeError.

    Raises:
        JobError: the task's own.
        ValueError: for a timeout of 0 or less.
    """
    from .memory import keep_freed

    keep_freed()
    with open(os.devnull, "w") as quiet:
        if timeout is not None:
            faulthandler.dump_traceback_later(timeout, exit=True, file=quiet)
        try:
            return attempt(task, threads)
        except JobError:
            raise
        except Exception as error:
            return TaskOutcome(task.makes, f"{type(error).__name__}: {error}")
        finally:
            faulthandler.cancel_dump_traceback_later()


def cores() -> int:
    """Return the number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
