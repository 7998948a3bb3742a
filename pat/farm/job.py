"""The configuration of a job: the file that people write, and the manifest in the job's folder."""

from __future__ import annotations

import json
import platform
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import yaml

from arraygeom.atomic import write_text
from arraygeom.rig import Rig
from arraygeom.safe_yaml import load_yaml
from pat.sensors import seed_for
from pat.support.schema import from_document, read_yaml, to_document
from pat.synthesis.check import CheckLimits

from .backends import BlenderSettings, LayeredSettings, Renderer
from .folders import JobFolder
from .workshop import RetryLimits

MANIFEST = "manifest.yaml"
FORMAT = "pat-render 1"


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """A file for `pat render`:

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
        blender = (
            self.blender if self.blender.photos is None else replace(self.blender, photos=folder / self.blender.photos)
        )
        config = replace(self, rig=folder / self.rig, layered=replace(self.layered, photos=photos), blender=blender)
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

    def load_rig(self) -> Rig:
        """The cameras. Raises ValueError, also if the backend cannot render them."""
        rig = Rig.load(self.rig)
        self.settings.check_rig(rig)
        return rig

    def renderer(self) -> Renderer:
        """A renderer that is ready. Raises ValueError for a rig that it cannot render, or if a library is missing."""
        return self.settings.renderer(self.load_rig(), self.check)

    def scene_bytes(self) -> float:
        """Approximate bytes of a scene on disk: 2 a colour and 4 for depth, before compression."""
        return sum(10.0 * h * w for h, w in self.settings.images(self.load_rig())) + 20_000

    def identity(self) -> dict[str, Any]:
        """All that the scenes depend on."""
        rig = load_yaml(self.rig.read_text(encoding="utf-8")) if self.rig.is_file() else str(self.rig)
        return {
            "backend": self.backend,
            "seed": self.seed,
            "settings": to_document(self.settings),
            "check": to_document(self.check),
            "rig": rig,
        }


@dataclass(frozen=True, kw_only=True)
class Job:
    """A configuration and the folder it is rendered into, one shard of it; workers read it from a file."""

    config: RenderConfig
    root: Path
    tag: str

    @property
    def folder(self) -> JobFolder:
        """The folder."""
        return JobFolder(self.root)

    def seed(self, index: int, attempt: int) -> int:
        """The seed of a scene; another one for every attempt that the self-check refused."""
        return seed_for(self.config.seed, "scene", index, attempt)

    @property
    def file(self) -> Path:
        """Where workers read this job."""
        return self.folder.work / f"job-{self.tag}.json"

    def save(self) -> None:
        """Write the file for workers."""
        document = {"root": str(self.root), "tag": self.tag, "config": to_document(self.config)}
        write_text(self.file, json.dumps(document))

    @classmethod
    def load(cls, path: Path) -> Job:
        """Read it again."""
        document = json.loads(path.read_text(encoding="utf-8"))
        config = from_document(RenderConfig, document["config"])
        return cls(config=config, root=Path(document["root"]), tag=document["tag"])

    def write_manifest(self) -> None:
        """Write the manifest, or check that the existing one is the same.

        Raises ValueError if the folder holds scenes of another configuration.
        """
        path, identity = self.root / MANIFEST, self.config.identity()
        if path.is_file():
            former = read_yaml(path).get("made from", {})
            other = [key for key in identity if former.get(key) != json.loads(json.dumps(identity[key]))]
            if other:
                raise ValueError(
                    f"{self.root} holds scenes made from another {' and '.join(other)}: give another --out, "
                    f"or put {self.config.rig.name if other == ['rig'] else 'the configuration'} back"
                )
            return
        manifest = {"format": FORMAT, "made from": json.loads(json.dumps(identity)), "versions": versions()}
        write_text(path, yaml.safe_dump(manifest, sort_keys=False, width=120, default_flow_style=None))

    def write_table(self, fact_file: str) -> int:
        """Write `scenes.jsonl` from the files in the scenes' folders; the number of scenes."""
        facts = [(self.folder.scene(i) / fact_file) for i in self.folder.done()]
        lines = [json.dumps(json.loads(path.read_text(encoding="utf-8"))) for path in facts]
        write_text(self.root / "scenes.jsonl", "".join(line + "\n" for line in lines))
        return len(lines)


def versions() -> dict[str, str]:
    """Versions of the packages that rendering uses."""
    found = {"python": platform.python_version()}
    for package in ("arraygeom-pat", "torch", "numpy", "bpy", "OpenEXR"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
