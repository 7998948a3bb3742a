"""Rendering of many scenes: the configuration file, and the job that renders missing scenes.

A job's folder holds `manifest.yaml` (what is rendered, by which versions) and `scenes/000012/` (scene 12; the
folder exists only if it is complete). `.work` holds unfinished scenes.
"""

from __future__ import annotations

import errno
import json
import math
import os
import platform
import shutil
import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal
from uuid import uuid4

from rich.console import Console

from arraygeom.io.native import write as rig_text
from arraygeom.rig import Rig
from arraygeom.runtime.atomic import flush, write_text
from arraygeom.runtime.safe_yaml import dump_yaml, load_yaml
from arraygeom.runtime.together import sweep
from pat.lab.synthesis.check import CheckLimits
from pat.lab.synthesis.rendered import Rendered
from pat.sensors import seed_for
from pat.support.folders import check_apart
from pat.support.jobs import JobError, JobReport, Task, Workers, run_tasks
from pat.support.locks import folder_lock
from pat.support.memory import resident
from pat.support.schema import check_fields, from_document, read_yaml, to_document

from .backends import BlenderSettings, LayeredSettings, Renderer

MANIFEST = "manifest.yaml"
FORMAT = "pat-render 1"
FACTS = "farm.json"
"""File in every scene's folder: its number, attempt, seed, figures of the self-check, and cost."""
RESERVE = 64 << 20
"""Bytes of disk that stay free."""


@dataclass(frozen=True, kw_only=True)
class RetryLimits:
    """Limits on the attempts at a scene.

    Attributes:
        timeout: seconds for a scene, all its seeds together, more than 0; not kept by Dask's workers.
        refusals: seeds tried while the self-check refuses them or they cannot be rendered, more than 0.

    Raises:
        ValueError: for values of 0 or less, and NaN.
    """

    timeout: float = 900.0
    refusals: int = 20

    def __post_init__(self) -> None:
        check_fields(self, "timeout refusals", 0, above=True)


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """A file for `pat lab render`:

        rig: rig.yaml            # beside this file
        seed: 1
        backend: blender         # or layered
        blender: {generator: abstract, preset: fast}
        check: {overlap: 0.3}    # requirements of the self-check
        limits: {timeout: 300}   # seconds a scene, and how often to try

    Settings of the backend that is not used are checked, and have no effect. `load` reads such a file.
    """

    rig: Path
    """File of the rig."""
    seed: int = 0
    """Seed of all scenes."""
    backend: Literal["layered", "blender"] = "layered"
    """Renderer of the scenes."""
    layered: LayeredSettings = field(default_factory=LayeredSettings)
    """Settings of the layered renderer."""
    blender: BlenderSettings = field(default_factory=BlenderSettings)
    """Settings of the Blender renderer."""
    check: CheckLimits = field(default_factory=CheckLimits)
    """Requirements of the self-check."""
    limits: RetryLimits = field(default_factory=RetryLimits)
    """Limits of time and tries."""

    @classmethod
    def load(cls, path: str | Path) -> RenderConfig:
        """Read a configuration file; paths in it are relative to it.

        Returns:
            The configuration, with absolute paths.

        Raises:
            FileNotFoundError: for a missing configuration file.
            ValueError: naming the file, for an invalid entry, and as `beside`.
        """
        path = Path(path)
        try:
            return from_document(cls, read_yaml(path)).beside(path.absolute().parent)
        except ValueError as error:
            prefix = "" if str(error).startswith(str(path)) else f"{path}: "
            raise ValueError(f"{prefix}{error}") from None

    def beside(self, folder: Path) -> RenderConfig:
        """Resolve the paths of the configuration relative to a folder, and check that the used ones exist.

        Returns:
            The configuration, its paths joined to the folder.

        Raises:
            ValueError: for a missing rig file or, of the chosen backend, folder of photographs.
        """
        photos = tuple(folder / p for p in self.layered.photos)
        blender = self.blender
        if blender.photos is not None:
            blender = replace(blender, photos=folder / blender.photos)
        layered = replace(self.layered, photos=photos)
        config = replace(self, rig=folder / self.rig, layered=layered, blender=blender)
        needed = [config.rig, *(photos if self.backend == "layered" else ())]
        needed += [blender.photos] if self.backend == "blender" and blender.photos else []
        for path in needed:
            if not path.exists():
                raise ValueError(f"{path}: no such file or folder")
        return config

    @property
    def settings(self) -> LayeredSettings | BlenderSettings:
        """Settings of the chosen backend."""
        return self.layered if self.backend == "layered" else self.blender

    def renderer(self) -> Renderer:
        """Prepare the renderer of the chosen backend.

        Returns:
            A function that renders the scene of a seed into a new folder: `render(seed, out)`.

        Raises:
            FileNotFoundError: for a missing file of the rig.
            ValueError: for a rig that cannot be read; it and further errors as the backend's `images` and
                `renderer`.
        """
        rig = Rig.load(self.rig)
        self.settings.images(rig)  # refuses rigs
        return self.settings.renderer(rig, self.check)

    def scene_bytes(self) -> float:
        """Estimate the bytes of a scene on disk: 2 for each colour and 4 for depth of a pixel, before
        compression, without near infrared.

        Returns:
            Bytes of all its images and other files together.

        Raises:
            ValueError: for a rig that cannot be read, and as the backend's `images`.
            FileNotFoundError: for a missing file of the rig.
        """
        return sum(10.0 * h * w for h, w in self.settings.images(Rig.load(self.rig))) + 20_000

    def identity(self) -> dict[str, Any]:
        """Return everything that the scenes depend on, as a plain document."""
        return {
            "backend": self.backend,
            "seed": self.seed,
            "settings": to_document(self.settings),
            "check": to_document(self.check),
            "rig": load_yaml(rig_text(Rig.load(self.rig))),
        }


@dataclass(frozen=True)
class Shard:
    """Part of a job: scenes number - 1, number - 1 + count, and so on.

    Attributes:
        number: number of the part, from 1.
        count: number of parts.
    """

    number: int = 1
    count: int = 1

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Parse text such as "2/4".

        >>> Shard.parse("2/4").select(10)
        [1, 5, 9]

        Raises:
            ValueError: for other text, and a number outside 1 to the count.
        """
        number, _, count = text.partition("/")
        if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
            raise ValueError(f"--shard: '{text}' is not i/n with i from 1 to n, such as 2/4")
        return cls(int(number), int(count))

    def select(self, scenes: int) -> list[int]:
        """List the scenes of this part of a job.

        Args:
            scenes: number of scenes of the whole job.

        Returns:
            Numbers of the part's scenes, from 0.
        """
        return list(range(self.number - 1, scenes, self.count))


def render(
    config: RenderConfig,
    *,
    scenes: int,
    out: Path,
    workers: int = 1,
    shard: Shard = Shard(),
    scheduler: str | None = None,
    console: Console | None = None,
) -> JobReport:
    """Render the missing ones of `scenes` scenes into folder `out`.

    Args:
        config: configuration of the job.
        scenes: number of scenes of the whole job.
        out: folder of the job, made if missing.
        workers: processes on this machine.
        shard: part of the scenes to render.
        scheduler: address of a Dask scheduler whose workers render instead; None for this machine.
        console: console for the progress; None for standard error.

    Returns:
        Report of the scenes made, kept and failed; a failed scene is skipped.

    Raises:
        ValueError: for a rig or generator that cannot be used, scenes or workers below 1, more scenes than
            the disk holds, an `out` among the photographs, in use or of another configuration, and a
            `scheduler` that does not answer.
        JobError: if the job cannot go on, such as on a full disk or without Blender.
        FileNotFoundError: for a missing file of the rig.
        ImportError, TimeoutError: for a `scheduler` without the package of Dask, or without workers.
    """
    if scenes < 1 or workers < 1:
        raise ValueError(f"give at least one scene and one worker, got --scenes {scenes} --workers {workers}")
    check_apart(out, (*config.layered.photos, *filter(None, [config.blender.photos])))
    scene_bytes = config.scene_bytes()
    root = Path(out).absolute()
    work = root / ".work" / f"{shard.number}of{shard.count}"
    with folder_lock(work):
        for left in work.iterdir():
            if left.is_dir():
                shutil.rmtree(left)
        if shard.count == 1:  # no other run writes to this folder
            sweep(root)
        write_manifest(config, root)
        arguments = json.dumps(to_document(config)), work
        folders = {i: root / "scenes" / f"{i:06d}" for i in shard.select(scenes)}
        check_space(root, sum(not folder.exists() for folder in folders.values()), scene_bytes)
        tasks = [Task(f, make_scene, (*arguments, f, i), f"scene {i}") for i, f in folders.items()]
        return run_tasks(
            tasks,
            workers=Workers(workers, scheduler, apart=True, timeout=config.limits.timeout),
            resume=True,
            on_error="skip",
            title="scenes",
            console=console,
        )


def write_manifest(config: RenderConfig, root: Path) -> None:
    """Write a job's manifest into its folder `root`, or check that the existing one is of the same job.

    Raises:
        ValueError: if the manifest is of another configuration, or does not say, or a file is damaged.
        FileNotFoundError: for a missing file of the rig.
        OSError: if the manifest cannot be written.
    """
    path, identity = root / MANIFEST, json.loads(json.dumps(config.identity()))
    if path.is_file():
        manifest = read_yaml(path)
        former = manifest.get("made from") if isinstance(manifest, dict) else None
        if not isinstance(former, dict):
            raise ValueError(f"{path}: does not say what its scenes are made from: give another --out")
        other = [key for key in identity if former.get(key) != identity[key]]
        if other:
            changed = config.rig.name if other == ["rig"] else "the configuration"
            text = f"{root} holds scenes made from another {' and '.join(other)}"
            raise ValueError(f"{text}: give another --out, or put {changed} back")
        return
    manifest = {"format": FORMAT, "made from": identity, "versions": versions()}
    write_text(path, dump_yaml(manifest, width=120, default_flow_style=None))


def versions() -> dict[str, str]:
    """Return the versions of the installed packages that rendering uses, by name."""
    versions = {"python": platform.python_version()}
    for package in ("arraygeom-pat", "torch", "numpy", "OpenEXR"):
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return versions


def check_space(root: Path, scenes: int, scene_bytes: float) -> None:
    """Check that the disk of folder `root` has room for `scenes` more of `scene_bytes` bytes, and `RESERVE`.

    Raises:
        FileNotFoundError: for a missing folder.
        ValueError: with how many would fit, if it does not.
    """
    need, free = scenes * scene_bytes + RESERVE, shutil.disk_usage(root).free
    if scenes and need > free:
        fits = max(int((free - RESERVE) / scene_bytes), 0)
        raise ValueError(
            f"{scenes} more scenes of about {scene_bytes / 1e6:.1f} MB need {need / 1e9:.1f} GB and {root} "
            f"has {free / 1e9:.1f} GB free: {fits} would fit; free space, ask for fewer --scenes, "
            "or another --out"
        )


def make_scene(config_text: str, work: Path, scene: Path, index: int) -> None:
    """Render one scene from the first seed that the self-check accepts, and publish its folder.

    Args:
        config_text: the `RenderConfig` as JSON, with absolute paths.
        work: folder for unfinished scenes, on the disk of `scene`.
        scene: folder of the finished scene; an existing one stays.
        index: number of the scene, from which its seeds follow.

    Raises:
        ValueError: if `refusals` seeds are refused, by the self-check or since they cannot be rendered.
        JobError: if no scene can be made: a full disk, or a configuration that cannot be used.
        BrokenProcessPool: if Blender's process dies.
        OSError: if a file cannot be read or written for another reason. Other errors of a generator pass.
    """
    config, render_scene = _ready(config_text)
    reason = ""
    for attempt in range(config.limits.refusals):
        seed = scene_seed(config, index, attempt)
        partial = work / f"{index:06d}-{uuid4().hex[:12]}"
        wall, cpu = time.monotonic(), sum(os.times()[:4])  # Blender's process is a child
        try:
            render_scene(seed, partial)
            check = Rendered(partial).about["check"]
            if check["accepted"]:
                facts = {
                    "scene": index,
                    "attempt": attempt,
                    "seed": seed,
                    "check": check,
                    "seconds": round(time.monotonic() - wall, 3),
                    "cpu_seconds": round(sum(os.times()[:4]) - cpu, 3),
                    "memory_mb": round((resident() or math.nan) / 1e6, 1),
                    "process": os.getpid(),
                }
                (partial / FACTS).write_text(json.dumps(facts, indent=1), encoding="utf-8")
                return publish(partial, scene)
            reason = "; ".join(check["reasons"])
        except ValueError as error:  # a camera inside an object, for instance
            reason = str(error)
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                raise
            raise JobError(f"the disk of {work} is full: free space and run the same command again") from None
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    raise ValueError(f"{config.limits.refusals} seeds were refused, the last one: {reason}")


def scene_seed(config: RenderConfig, index: int, attempt: int) -> int:
    """Return the seed of attempt number `attempt`, from 0, at scene number `index`."""
    return seed_for(config.seed, "scene", index, attempt)


@lru_cache(maxsize=1)
def _ready(config_text: str) -> tuple[RenderConfig, Renderer]:
    try:
        config = from_document(RenderConfig, json.loads(config_text))
        return config, config.renderer()
    except ValueError as error:
        raise JobError(f"{error}") from None


def publish(partial: Path, final: Path) -> None:
    """Rename the complete folder `partial`, of files alone, to `final` after all of it is on disk.

    A `final` that exists and is not empty stays, and `partial` too.

    Raises:
        OSError: if it cannot be renamed.
    """
    for path in [*partial.iterdir(), partial]:
        flush(path)
    final.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.rename(partial, final)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            raise
    flush(final.parent)


def summarise(root: Path) -> str:
    """Summarise rendered scenes: number, the first one's image sizes, disk, time, memory and refused seeds.

    Returns:
        Two lines of text, the second of those scenes that have a farm.json; one line if none has.

    Raises:
        FileNotFoundError: for a missing folder.
        ValueError: for a folder without scenes, with an incomplete one, or whose first rig or a farm.json
            cannot be read, or lacks an entry.
    """
    from statistics import median

    from pat.lab.data.windows import scene_folders, scene_rig

    folders = scene_folders(root)
    rig = scene_rig(folders[0])
    size = sum(file.stat().st_size for folder in folders for file in folder.iterdir())
    sizes = ", ".join(f"{name} {c.hw[1]}x{c.hw[0]}" for name, c in rig.cameras.items())
    text = (
        f"{len(folders)} scenes of {sizes}; "
        f"{size / 1e6 / len(folders):.2f} MB each, {size / 1e9:.2f} GB in all"
    )
    figures = [_figures(f / FACTS) for f in folders if (f / FACTS).is_file()]
    if not figures:
        return text
    seconds, cpu, memory, refused = zip(*figures)
    return (
        f"{text}\na scene took {median(seconds):.1f} s, {median(cpu):.1f} s of a core (medians); workers had "
        f"up to {max(memory):.0f} MB; {sum(refused):.0f} seeds were refused by the check"
    )


def _figures(path: Path) -> list[float]:
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
        return [float(facts[key]) for key in ("seconds", "cpu_seconds", "memory_mb", "attempt")]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: is damaged ({error!r}): remove the folder and render it again") from None
