"""Many workshops at once: threads on this machine, or Dask on any number of machines. The scenes are the same.

On a cluster every worker sees the job's folder under the same path (a network file system). With Slurm:

    from dask_jobqueue import SLURMCluster
    cluster = SLURMCluster(cores=16, processes=16, memory="64GB", walltime="08:00:00")
    cluster.scale(jobs=10)
    print(cluster.scheduler_address)      # tcp://...: give it to `pat render --scheduler`

A Dask worker makes one scene at a time for each of its threads, in a process of its own; so ask for as many
processes as cores, with one thread each. Where there is no Dask, `--shard i/n` divides a job among machines.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator, Sequence
from typing import Any

from ..support.jobs import environment_put_back
from .workshop import Order, Outcome, Stopped, Workshop

_LOCAL = threading.local()


def local_pool(order: Order, indices: Sequence[int], workers: int) -> Iterator[Outcome]:
    """Outcomes as they come, from `workers` processes. Raises Stopped when the job cannot go on."""
    waiting: queue.SimpleQueue[int] = queue.SimpleQueue()
    for index in indices:
        waiting.put(index)
    found: queue.SimpleQueue[Outcome | BaseException | None] = queue.SimpleQueue()
    stop = threading.Event()
    threads = [
        threading.Thread(target=_serve, args=(order, waiting, found, stop), daemon=True)
        for _ in range(min(workers, len(indices)))
    ]
    for thread in threads:
        thread.start()
    try:
        yield from _collected(found, len(threads))
    finally:
        stop.set()
        for thread in threads:
            thread.join()


def _collected(found: queue.SimpleQueue[Outcome | BaseException | None], serving: int) -> Iterator[Outcome]:
    while serving:
        outcome = found.get()
        if isinstance(outcome, BaseException):
            raise outcome
        if outcome is None:
            serving -= 1
        else:
            yield outcome


def _serve(
    order: Order,
    waiting: queue.SimpleQueue[int],
    found: queue.SimpleQueue[Outcome | BaseException | None],
    stop: threading.Event,
) -> None:
    """One thread: scenes from the queue until it is empty. The thread outlives its processes, as it must."""
    try:
        with Workshop(order, stop.is_set) as workshop:
            while not stop.is_set():
                found.put(workshop.make(waiting.get_nowait()))
    except queue.Empty:
        pass
    except BaseException as error:
        found.put(error)
    found.put(None)


def dask_pool(order: Order, indices: Sequence[int], scheduler: str, workers: int) -> Iterator[Outcome]:
    """Outcomes as they come, from a Dask cluster: `scheduler` is its address, or "local" for one on this machine.

    Raises Stopped when the job cannot go on; ValueError if Dask is not installed or the scheduler does not answer.
    """
    distributed = _distributed()
    with (
        environment_put_back(),
        _cluster(distributed, scheduler, workers) as address,
        _client(distributed, address) as client,
    ):
        futures = {client.submit(make_scene, order, index, pure=False, retries=3): index for index in indices}
        try:
            for future in distributed.as_completed(futures):
                outcome = future.result() if future.status == "finished" else _lost(futures[future], future)
                if isinstance(outcome, str):
                    raise Stopped(outcome)
                yield outcome
        finally:
            client.cancel(list(futures))


def _lost(index: int, future: Any) -> Outcome:
    """A scene whose Dask workers died again and again."""
    return Outcome(index=index, state="stopped", reason=str(future.exception()))


def make_scene(order: Order, index: int) -> Outcome | str:
    """Make a scene with this thread's workshop; why the job cannot go on, if it cannot."""
    workshop = getattr(_LOCAL, "workshop", None)
    if workshop is None or workshop.order != order:
        if workshop is not None:
            workshop.close()
        workshop = _LOCAL.workshop = Workshop(order)
    try:
        return workshop.make(index)
    except Stopped as error:
        return str(error)


def _distributed() -> Any:
    try:
        import distributed
    except ImportError:
        raise ValueError("--scheduler needs Dask: pip install 'arraygeom-pat[cluster]'") from None
    return distributed


def _client(distributed: Any, address: Any) -> Any:
    try:
        return distributed.Client(address, timeout=30)
    except (OSError, ValueError) as error:
        raise ValueError(f"--scheduler: no Dask scheduler answers at {address} ({error})") from None


def _cluster(distributed: Any, scheduler: str, workers: int) -> Any:
    from contextlib import nullcontext

    if scheduler != "local":
        return nullcontext(scheduler)
    return distributed.LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None)
