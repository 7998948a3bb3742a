"""A job from its configuration to its last scene, with progress."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console

from arraygeom.atomic import sweep

from ..support.jobs import Workers, followed
from .folders import RESERVE, JobFolder, Shard
from .job import Job, RenderConfig
from .pools import dask_pool, local_pool
from .worker import FACTS
from .workshop import Order, SceneOutcome, worker_command


@dataclass
class RenderSummary:
    """Scenes made by a run, and what went wrong."""

    made: int = 0
    there: int = 0
    given_up: list[int] = field(default_factory=list)
    stopped: list[str] = field(default_factory=list)
    """Why, for each scene that could not be tried to the end."""
    refusals: int = 0
    crashes: int = 0
    started: float = field(default_factory=time.monotonic)
    seconds: float = 0.0

    def add(self, outcome: SceneOutcome) -> str:
        """Count a scene; the figures so far."""
        self.seconds = time.monotonic() - self.started
        self.made += outcome.state == "done"
        self.there += outcome.state == "there"
        self.refusals += outcome.refusals
        self.crashes += outcome.crashes
        if outcome.state == "given up":
            self.given_up.append(outcome.index)
        if outcome.state == "stopped":
            self.stopped.append(outcome.reason)
        return f"{self.rate:.0f} an hour, {self.refusals} refused, {self.crashes} crashed"

    @property
    def complete(self) -> bool:
        """Whether every scene that was asked for is there."""
        return not (self.given_up or self.stopped)

    @property
    def rate(self) -> float:
        """Scenes an hour."""
        return 3600 * self.made / self.seconds if self.seconds else 0.0

    def __str__(self) -> str:
        extra = [f"{n} {what}" for n, what in ((self.refusals, "refused by the check"), (self.crashes, "crashed")) if n]
        if self.given_up:
            extra.append(
                f"given up: {', '.join(map(str, self.given_up[:10]))}{' ...' if len(self.given_up) > 10 else ''}"
            )
        if self.stopped:
            reason = next(filter(None, self.stopped), "")
            extra.append(f"{len(self.stopped)} not made{f' ({reason})' * bool(reason)}: run the command again")
        return ", ".join([f"{self.made} scenes made, {self.there} were there", f"{self.rate:.0f} an hour", *extra])


def render(
    config: RenderConfig,
    *,
    scenes: int,
    out: Path,
    workers: int = 1,
    shard: Shard = Shard(),  # noqa: B008
    scheduler: str | None = None,
    console: Console | None = None,
) -> RenderSummary:
    """Render what is missing of `scenes` scenes into the folder `out`.

    With `scheduler`, on a Dask cluster (see `pat.farm.pools`), else by `workers` processes. Scenes that are there
    or in quarantine are left alone. Raises ValueError for what cannot be rendered, more scenes than the disk
    holds, or a folder in use or of another configuration; JobError if the job cannot go on.
    """
    if scenes < 1 or workers < 1:
        raise ValueError(f"give at least one scene and one worker, got --scenes {scenes} --workers {workers}")
    config.load_rig()
    job = Job(config=config, root=Path(out).absolute(), tag=shard.tag)
    job.root.mkdir(parents=True, exist_ok=True)
    with job.folder.locked(shard.tag):
        wanted = shard.of(scenes)
        summary, missing, order = _prepared(job, wanted)
        if scheduler is None:
            outcomes = local_pool(order, missing, workers)
        else:
            outcomes = dask_pool(order, missing, Workers(workers, scheduler))
        console, done = console or Console(stderr=True), len(wanted) - len(missing)
        try:
            for _ in followed(
                outcomes, title="scenes", total=len(wanted), done=done, console=console, status=summary.add
            ):
                pass
        finally:
            with suppress(OSError):
                job.write_table(FACTS)
    return summary


def _prepared(job: Job, wanted: list[int]) -> tuple[RenderSummary, list[int], Order]:
    """What there is, the scenes that are missing, and the order for the workers. Raises ValueError."""
    folder, config = job.folder, job.config
    folder.clean(job.tag)
    if job.tag == Shard().tag:  # no other run writes to this folder
        sweep(job.root)
    job.write_manifest()
    job.save()
    done, given_up = set(folder.done()), set(folder.given_up())
    missing = [i for i in wanted if i not in done | given_up]
    size = folder.bytes_per_scene() or config.scene_bytes()
    check_space(folder, len(missing), size)
    command = worker_command(job.file)
    order = Order(root=job.root, tag=job.tag, command=command, limits=config.limits, scene_bytes=size)
    return RenderSummary(there=len(done & set(wanted)), given_up=sorted(given_up & set(wanted))), missing, order


def check_space(folder: JobFolder, scenes: int, scene_bytes: float) -> None:
    """Raises ValueError if so many more scenes do not fit on the disk."""
    need, free = scenes * scene_bytes + RESERVE, folder.free()
    if scenes and need > free:
        fits = max(int((free - RESERVE) / scene_bytes), 0)
        raise ValueError(
            f"{scenes} more scenes of about {scene_bytes / 1e6:.1f} MB need {need / 1e9:.1f} GB and {folder.root} has "
            f"{free / 1e9:.1f} GB free: {fits} would fit; free space, ask for fewer --scenes, or another --out"
        )
