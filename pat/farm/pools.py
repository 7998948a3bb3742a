"""Many workshops at once: threads on this machine, or Dask on any number of machines. The scenes are the same.

On a cluster every worker sees the job's folder under the same path (a network file system). With Slurm:

    from dask_jobqueue import SLURMCluster
    cluster = SLURMCluster(cores=16, processes=16, memory="64GB", walltime="08:00:00")
    cluster.scale(jobs=10)
    print(cluster.scheduler_address)      # tcp://...: give it to `pat render --scheduler`

A Dask worker makes one scene at a time for each of its threads, in a process of its own; so ask for as many
processes as cores, with one thread each. Without Dask, `--shard i/n` divides a job among machines.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack

from ..support.jobs import JobError, Workers, completed, why
from .workshop import Order, SceneOutcome, Workshop

_LOCAL = threading.local()


def local_pool(order: Order, indices: Sequence[int], workers: int) -> Iterator[SceneOutcome]:
    """Outcomes as they come, from `workers` processes. Raises JobError when the job cannot go on.

    A process dies with the thread that started it; so each has a thread that lives until all scenes are made.
    """
    stop, own = threading.Event(), threading.local()
    with ExitStack() as workshops, ThreadPoolExecutor(workers) as threads:

        def make(index: int) -> SceneOutcome:
            if not hasattr(own, "workshop"):
                own.workshop = workshops.enter_context(Workshop(order, stop.is_set))
            return own.workshop.make(index)

        futures = [threads.submit(make, index) for index in indices]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            stop.set()
            threads.shutdown(cancel_futures=True)


def dask_pool(order: Order, indices: Sequence[int], workers: Workers) -> Iterator[SceneOutcome]:
    """Outcomes as they come, from a Dask cluster.

    Raises JobError when the job cannot go on; ValueError if Dask is not installed or the scheduler does not answer.
    """
    for (_, index), future in completed(make_scene, [(order, index) for index in indices], workers):
        outcome = future.result() if future.status == "finished" else None
        if isinstance(outcome, str):
            raise JobError(outcome)
        yield outcome or SceneOutcome(index=index, state="stopped", reason=why(future))


def make_scene(order: Order, index: int) -> SceneOutcome | str:
    """Make a scene with this thread's workshop; why the job cannot go on, if it cannot."""
    workshop = getattr(_LOCAL, "workshop", None)
    if workshop is None or workshop.order != order:
        if workshop is not None:
            workshop.close()
        workshop = _LOCAL.workshop = Workshop(order)
    try:
        return workshop.make(index)
    except JobError as error:
        return str(error)
