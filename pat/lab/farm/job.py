"""Many scenes rendered: a file that says what, and the job that makes those that are missing.

The folder of a job holds `manifest.yaml` (what is rendered, by which versions) and `scenes/000012/` (scene
12; that the folder exists means that it is complete). `.work` holds unfinished scenes.
"""

from __future__ import annotations

import errno
import json
import math
import os
import platform
import shutil
import time
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
from pat.support.jobs import JobError, JobReport, Task, Workers, run_tasks
from pat.support.locks import folder_lock
from pat.support.memory import resident
from pat.support.schema import from_document, read_yaml, to_document

from .backends import BlenderSettings, LayeredSettings, Renderer

MANIFEST = "manifest.yaml"
FORMAT = "pat-render 1"
FACTS = "farm.json"
"""In every scene's folder: its number, attempt, seed, figures of the self-check, and its cost."""
RESERVE = 64 << 20
"""Bytes of disk that stay free."""


@dataclass(frozen=True, kw_only=True)
class RetryLimits:
    """A scene may take `timeout` seconds; if its check refuses, the next seed is taken, `refusals` times."""

    timeout: float = 900.0
    refusals: int = 20

    def __post_init__(self) -> None:
        for name in ("timeout", "refusals"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be above 0, got {getattr(self, name):g}")


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """A file for `pat lab render`:

        rig: rig.yaml            # beside this file
        seed: 1
        backend: blender         # or layered
        blender: {generator: abstract, preset: fast}
        check: {overlap: 0.3}    # requirements of the self-check
        limits: {timeout: 300}   # seconds a scene, and how often to try

    Settings of the backend that is not used are ignored.
    """

    rig: Path
    seed: int = 0
    backend: Literal["layered", "blender"] = "layered"
    layered: LayeredSettings = field(default_factory=LayeredSettings)
    blender: BlenderSettings = field(default_factory=BlenderSettings)
    check: CheckLimits = field(default_factory=CheckLimits)
    limits: RetryLimits = field(default_factory=RetryLimits)

    @classmethod
    def load(cls, path: str | Path) -> RenderConfig:
        """Read a file; paths in it are relative to it. Raises ValueError naming the file and the entry."""
        path = Path(path)
        try:
            return from_document(cls, read_yaml(path)).beside(path.absolute().parent)
        except ValueError as error:
            prefix = "" if str(error).startswith(str(path)) else f"{path}: "
            raise ValueError(f"{prefix}{error}") from None

    def beside(self, folder: Path) -> RenderConfig:
        """The same with paths made absolute, as seen from a folder. Raises ValueError for missing ones."""
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
        """Those of the backend that is used."""
        return self.layered if self.backend == "layered" else self.blender

    def renderer(self) -> Renderer:
        """A ready renderer. Raises ValueError for a rig it cannot render, or if a library is missing."""
        rig = Rig.load(self.rig)
        self.settings.images(rig)  # refuses rigs
        return self.settings.renderer(rig, self.check)

    def scene_bytes(self) -> float:
        """Approximate bytes of a scene on disk: 2 a colour and 4 for depth, before compression.

        Raises ValueError for a rig that cannot be rendered.
        """
        return sum(10.0 * h * w for h, w in self.settings.images(Rig.load(self.rig))) + 20_000

    def identity(self) -> dict[str, Any]:
        """All that the scenes depend on."""
        return {
            "backend": self.backend,
            "seed": self.seed,
            "settings": to_document(self.settings),
            "check": to_document(self.check),
            "rig": load_yaml(rig_text(Rig.load(self.rig))),
        }


@dataclass(frozen=True)
class Shard:
    """Part `number` (from 1) of `count`: scenes number - 1, number - 1 + count, and so on."""

    number: int = 1
    count: int = 1

    @classmethod
    def parse(cls, text: str) -> Shard:
        """From "2/4". Raises ValueError.

        >>> Shard.parse("2/4").of(10)
        [1, 5, 9]
        """
        number, _, count = text.partition("/")
        if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
            raise ValueError(f"--shard: '{text}' is not i/n with i from 1 to n, such as 2/4")
        return cls(int(number), int(count))

    def of(self, scenes: int) -> list[int]:
        """The scenes of this part."""
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
    """Render what is missing of `scenes` scenes into folder `out`, by `workers` processes or Dask's.

    Raises ValueError for what cannot be rendered, more scenes than the disk holds, or a folder in use or of
    another configuration; JobError if the job cannot go on.
    """
    if scenes < 1 or workers < 1:
        raise ValueError(f"give at least one scene and one worker, got --scenes {scenes} --workers {workers}")
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
        folders = {i: root / "scenes" / f"{i:06d}" for i in shard.of(scenes)}
        check_space(root, sum(not folder.exists() for folder in folders.values()), scene_bytes)
        return run_tasks(
            [
                Task(folder, make_scene, (*arguments, folder, i), f"scene {i}")
                for i, folder in folders.items()
            ],
            workers=Workers(workers, scheduler, apart=True, timeout=config.limits.timeout),
            resume=True,
            on_error="skip",
            title="scenes",
            console=console,
        )


def write_manifest(config: RenderConfig, root: Path) -> None:
    """Write the manifest, or check that the existing one is the same.

    Raises ValueError if the folder holds scenes of another configuration, or of none that is stated.
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
    """Versions of the packages that rendering uses."""
    versions = {"python": platform.python_version()}
    for package in ("arraygeom-pat", "torch", "numpy", "bpy", "OpenEXR"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def check_space(root: Path, scenes: int, scene_bytes: float) -> None:
    """Raises ValueError if so many more scenes do not fit on the disk."""
    need, free = scenes * scene_bytes + RESERVE, shutil.disk_usage(root).free
    if scenes and need > free:
        fits = max(int((free - RESERVE) / scene_bytes), 0)
        raise ValueError(
            f"{scenes} more scenes of about {scene_bytes / 1e6:.1f} MB need {need / 1e9:.1f} GB and {root} "
            f"has {free / 1e9:.1f} GB free: {fits} would fit; free space, ask for fewer --scenes, "
            "or another --out"
        )


def make_scene(config_text: str, work: Path, scene: Path, index: int) -> None:
    """The task of a scene: rendered from the first seed the self-check accepts, published as a whole.

    Raises ValueError for one that is refused again and again, JobError if no scene can be made.
    """
    config, render_scene = _ready(config_text)
    reason = ""
    for attempt in range(config.limits.refusals):
        seed = scene_seed(config, index, attempt)
        partial = work / f"{index:06d}-{uuid4().hex[:12]}"
        wall, cpu = time.monotonic(), time.process_time()
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
                    "cpu_seconds": round(time.process_time() - cpu, 3),
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
    """The seed of a scene; another one for every attempt that the self-check refused."""
    return seed_for(config.seed, "scene", index, attempt)


@lru_cache(maxsize=1)
def _ready(config_text: str) -> tuple[RenderConfig, Renderer]:
    try:
        config = from_document(RenderConfig, json.loads(config_text))
        return config, config.renderer()
    except ValueError as error:
        raise JobError(f"{error}") from None


def publish(partial: Path, final: Path) -> None:
    """Publish a complete folder under its name, after all of it is on disk; one that is there stays."""
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
    """Scenes, images, disk, time and memory, and refusals. Raises ValueError if there is none."""
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
    facts = [json.loads((f / FACTS).read_text(encoding="utf-8")) for f in folders if (f / FACTS).is_file()]
    if not facts:
        return text
    seconds, cpu = (median(f[key] for f in facts) for key in ("seconds", "cpu_seconds"))
    memory, refused = max(f["memory_mb"] for f in facts), sum(f["attempt"] for f in facts)
    return (
        f"{text}\na scene took {seconds:.1f} s, {cpu:.1f} s of a core (medians); workers had up to "
        f"{memory:.0f} MB; {refused} seeds were refused by the check"
    )
