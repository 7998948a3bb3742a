"""Fusion of many frames, and of sequences, from folders to a folder: `pat batch` and `pat sequence`.

Every frame is one task, whose files are swapped in together with their list (`write_together`).
`settings.yaml` beside the images records the settings, and a job is resumed only with the same ones; frames
whose images or results have changed, by their digests, are made again. One command at a time writes to a
folder. The colours of a sequence's key frames are stored until all frames are done.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, Literal

import torch
import yaml
from rich.console import Console
from torch import Tensor

from arraygeom import Rig
from arraygeom.io.native import read_text as rig_of_text
from arraygeom.io.native import write as rig_text
from arraygeom.lenses import CAMERA_MODELS
from arraygeom.runtime import together
from arraygeom.runtime.atomic import write_text
from arraygeom.runtime.extras import imported
from arraygeom.runtime.safe_yaml import dump_yaml, load_yaml
from arraygeom.runtime.threads import in_parallel

from ..fusion.checks import confidence_checked
from ..fusion.frame import Frame
from ..fusion.frames import ImageFiles
from ..fusion.fuse import FuseSettings, fuse_frame
from ..fusion.inputs import measured_along
from ..fusion.sequence import KeyColour, SequenceFusion, readable
from ..fusion.timeline import KeyFrame
from ..fusion.views import ViewFiles, Views
from ..media.images import read_image
from ..media.raw import developed_rig
from ..media.suffixes import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from ..media.video import check_video, write_video
from ..networks.weights import Precision, find_weights, load_weights
from ..sensors import NoiseLevel
from ..support.jobs import HERE, JobReport, OnError, Task, Workers, run_tasks
from ..support.locks import folder_lock
from ..support.memory import limited
from ..support.tensor_files import read_tensors, write_tensors
from .results import ImageFormat, band_names, fused_group, refuse_to_replace, save_frame, view_of

SETTINGS, VIDEO = "settings.yaml", "fused.mp4"
KEYS, PLAN = f"{together.LISTS}/keys", "plan.json"

PLAN_FORMAT = "pat-batch 1"
_network = lru_cache(maxsize=2)(load_weights)


@dataclass(frozen=True)
class Batch:
    """Job of fusing many frames, with all that its processes need to know.

    Attributes:
        rig: the rig of the files.
        files: files by camera, in the order of frames.
        alpha: camera whose view is fused.
        out: folder of the results.
        weights: weights by name or file.
        sequence: True to fuse in order of time, as `fuse_sequence`; False to fuse the first files of all
            cameras, then the second ones (`frame_matching` matches them).
        speed: fastest motion in a sequence, alpha's pixels a second; None estimates it (`SequenceFusion`).
        settings: settings of fusion.
        bits: bits of the fused image's values.
        kind: format of the fused image.
        alone: True to fuse each frame of a sequence by itself, without warping colour; for comparison.
        precision: precision of the network's convolutions, as for `load_weights`.
        strict: True to fail a frame of unfit confidence (`LowConfidenceWarning`).

    Raises:
        ValueError: for cameras that the rig lacks, no images of alpha, and unequal numbers of images unless
            `sequence`.
    """

    rig: Rig
    files: Mapping[str, Sequence[Path]]
    alpha: str
    out: Path
    weights: str = "mono-colour"
    sequence: bool = False
    speed: float | None = None
    settings: FuseSettings = FuseSettings()
    bits: int = 8
    kind: ImageFormat = "png"
    alone: bool = False
    precision: Precision = "float32"
    strict: bool = False

    def __post_init__(self) -> None:
        for name in self.files:
            self.rig.require(name)
        if self.alpha not in self.files:
            raise ValueError(f"no image of alpha, '{self.alpha}', only of {', '.join(self.files)}")
        if not self.sequence and len({len(files) for files in self.files.values()}) > 1:
            counts = ", ".join(f"{len(files)} of '{name}'" for name, files in self.files.items())
            raise ValueError(f"frames need as many images of each camera, got {counts}")

    @cached_property
    def names(self) -> list[str]:
        """Names of the frames: alpha's files without suffix, or numbers if two are equal."""
        names = [file.stem for file in self.files[self.alpha]]
        return names if len(set(names)) == len(names) else [f"{i:06d}" for i in range(len(names))]

    @cached_property
    def dependencies(self) -> str:
        """Settings, rig and digest of the weights (of a sequence also the numbers of images), as YAML text,
        computed once: all but the images and the program's version that the results depend on.

        Raises:
            FileNotFoundError: for unknown weights.
            ValueError: as `to_json`.
        """
        stamp = hashlib.sha256(find_weights(self.weights).read_bytes()).hexdigest()
        entries = json.loads(self.to_json())
        files = entries.pop("files")
        for name in ("format", "out", "strict"):
            del entries[name]
        del entries["settings"]["max_memory"]
        entries["weights"] = f"{self.weights} (SHA-256 {stamp[:16]})"
        if self.sequence:
            entries["frames"] = {name: len(paths) for name, paths in files.items()}
        return dump_yaml(entries)

    @cached_property
    def _of_sequence(self) -> str:
        """Digest of settings and all images of a sequence; empty for independent frames."""
        files = {name: list(map(together.digest, paths)) for name, paths in self.files.items()}
        return _digest([self.dependencies, files]) if self.sequence else ""

    def inputs(self, i: int) -> str:
        """Return a digest of the settings and the images that frame `i` depends on: all images in
        a sequence."""
        own = {name: together.digest(files[i]) for name, files in self.files.items() if not self.sequence}
        return self._of_sequence or _digest([self.dependencies, own])

    def list_file(self, i: int) -> Path:
        """Return the path of a frame's list of files, which exists once the frame is complete."""
        return together.list_file(self.out, fused_group(self.names[i]))

    def _is_made(self, i: int) -> bool:
        """True if a frame is complete and made from these images and settings."""
        about = together.read_about(self.out, fused_group(self.names[i]))
        return about is not None and about.get("inputs") == self.inputs(i)

    def fused_file(self, i: int) -> Path:
        """Return the path of frame `i`'s fused image."""
        return self.out / f"{self.names[i]}_fused.{self.kind}"

    def run(
        self,
        *,
        workers: Workers = HERE,
        resume: bool = False,
        on_error: OnError = "stop",
        video: float | None = None,
        console: Console | None = None,
    ) -> JobReport:
        """Fuse all frames.

        Args:
            workers: processes that frames are fused in.
            resume: True to keep complete frames of the same images and settings.
            on_error: "stop" at the first frame that fails, or "skip" it.
            video: frames for each second of fused.mp4, written at the end; None for no video.
            console: console for progress and messages; None for standard error.

        Returns:
            Frames made, kept and failed, each by its `list_file`.

        Raises:
            JobError: for a frame or key frame that fails with on_error="stop"; otherwise as `run_tasks`.
            ValueError: to resume with other settings, an `out` that images are in, in use or not writable, an
                invalid video rate, a scheduler that does not answer, and as `to_json` and `SequenceFusion`.
            ImportError: for a video without the extra `video`, and a scheduler without Dask.
            FileExistsError: for files in the way that no run wrote.
            OSError: if files cannot be written, on a full disk for instance, and for unknown weights.
        """
        if video is not None:
            check_video(video)
        plan, many = self.out / KEYS / PLAN, range(len(self.names))
        how: dict[str, Any] = {"workers": workers, "resume": resume, "on_error": on_error, "console": console}
        modules, folders = self.modules, {p.resolve().parent for paths in self.files.values() for p in paths}
        if self.out.resolve() in folders:
            raise ValueError(f"--out: images are read from {self.out}: give another folder for the results")
        with folder_lock(self.out):
            self._begin(resume)
            if self.sequence:
                self.fusion.timeline.warn_of_ends()
            if self.sequence and not self.alone:
                missing = [i for i in many if not self.list_file(i).exists()]
                keys = [(k, f"key frame {self.names[k.alpha]}") for k in self.fusion.keys_of(missing)]
                first = [Task(self._key_file(k), fuse_key, (plan, k, modules), about) for k, about in keys]
                run_tasks(first, title="key frames", **how)
            given = [(plan, i, self._of_sequence, modules) for i in many]
            tasks = [Task(self.list_file(i), fuse_one, given[i], self.fused_file(i).name) for i in many]
            report = run_tasks(tasks, title="frames", **{**how, "resume": True})
            if video is not None and (report.made or report.kept):
                made = [self.fused_file(i) for i in many if self.list_file(i).exists()]
                with together.write_together(self.out, group=VIDEO, last=VIDEO) as folder:
                    write_video(folder / VIDEO, (read_image(p) for p in made), rate=video)
            if not report.failed:
                shutil.rmtree(self.out / KEYS)
            return report

    def _begin(self, resume: bool) -> None:
        """Write settings and plan, and retire incomplete frames; to resume, compare former settings."""
        text, file = self.dependencies, self.out / SETTINGS
        changed = _differing(text, file.read_text(encoding="utf-8")) if resume and file.is_file() else []
        if changed:
            raise ValueError(
                f"{file}: the frames there were made with other settings ({', '.join(changed)}): "
                "give the same ones, or another --out"
            )
        vars(self).pop("_of_sequence", None)  # files may have changed since another run
        together.sweep(self.out)
        refuse_to_replace(self.out, self.names)
        same = [partial(self._is_made, i) for i in range(len(self.names))]
        made = in_parallel(same) if resume else [False] * len(same)
        before = self.out / KEYS / "inputs.txt"
        if not (resume and before.is_file() and before.read_text() == self._of_sequence):
            shutil.rmtree(self.out / KEYS, ignore_errors=True)
        for name, kept in zip(self.names, made):
            if not kept:
                together.retire(self.out, fused_group(name))
        together.sweep(self.out / KEYS)
        write_text(before, self._of_sequence)
        together.write_listed(file, text)
        write_text(self.out / KEYS / PLAN, self.to_json())

    def to_json(self) -> str:
        """Format the batch as JSON text, for processes that fuse its frames.

        Raises:
            ValueError: for a field that is no dataclass, and a rig that no file holds (`io.native.write`).
        """
        entries = {entry.name: getattr(self, entry.name) for entry in dataclasses.fields(self)}
        return json.dumps({"format": PLAN_FORMAT, **entries}, default=_plain)

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules of cameras and of the batch's fields, for processes that fuse its frames."""
        fields = re.findall(r'"kind": "([\w.]+):', self.to_json())
        return (*sorted({*fields, *(kind.__module__ for kind in CAMERA_MODELS.values())}),)

    @classmethod
    def from_json(cls, text: str, source: str = PLAN) -> Batch:
        """Parse the text of `to_json`, which messages call `source`, once `modules` are imported.

        Raises:
            ValueError: for other text.
        """
        try:
            entries = json.loads(text, object_hook=_made)
            if entries.pop("format") != PLAN_FORMAT:
                raise ValueError("another version's")
            entries["rig"] = rig_of_text(entries["rig"], source)
            entries["files"] = {n: [Path(file) for file in files] for n, files in entries["files"].items()}
            entries["out"] = Path(entries["out"])
            settings = entries["settings"]
            settings |= {n: tuple(v) for n, v in settings.items() if isinstance(v, list)}
            return cls(**{**entries, "settings": FuseSettings(**settings)})
        except (AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
            raise ValueError(f"{source}: not a plan of this program ({error}): start the job again") from None

    @cached_property
    def fusion(self) -> SequenceFusion:
        """Fusion of the sequence, with the images that its frames share."""
        frames = {n: ImageFiles(files, self.rig, n, alpha=self.alpha) for n, files in self.files.items()}
        rig, network = developed_rig(self.rig, self.files), _network(self.weights, precision=self.precision)
        return SequenceFusion(network, rig, frames, self.alpha, self.speed, self.settings)

    def _key_file(self, key: KeyFrame) -> Path:
        return self.out / KEYS / f"{key.alpha:08d}.safetensors"

    def _fetch(self, key: KeyFrame) -> KeyColour | None:
        file = self._key_file(key)
        try:
            return KeyColour(**read_tensors(file)[0]) if file.exists() else None
        except ValueError as error:
            image = self.files[self.alpha][key.alpha]
            raise ValueError(f"{image}: its colour, {error}: begin again without --resume") from None

    def fuse_key(self, key: KeyFrame) -> None:
        """Fuse and write the colour of a key frame.

        Raises:
            ValueError: if it cannot be fused.
        """
        with confidence_checked(strict=self.strict):
            colour = self.fusion.colour(key)
        write_tensors(self._key_file(key), colour._asdict())

    def fuse_one(self, i: int, inputs: str = "") -> None:
        """Fuse frame `i`, and write its files into the folder `out` (`save_frame`).

        A frame of a sequence takes colours that `fuse_key` has written, unless `alone`; it needs one of them.

        Args:
            i: number of the frame, from 0; IndexError beyond the last.
            inputs: digest of what the frame depends on (`inputs`), if known; empty to compute it.

        Raises:
            ValueError: if it cannot be fused.
            LowConfidenceWarning: for unfit confidence if `strict`.
            OSError: if a file cannot be read or written, or is in the way, and for unknown weights.
        """
        with limited(self.settings.limit):
            with confidence_checked(strict=self.strict):
                frame = self._frame(i)
            view = view_of(self.rig, self.alpha, bits=self.bits, bands=len(frame.image))
            save_frame(
                frame,
                self.out,
                bits=self.bits,
                kind=self.kind,
                view=view,
                name=self.names[i],
                bands=band_names(frame, self._betas) or self._propagated_bands(frame),
                about={"inputs": inputs or self.inputs(i)},
                along=self._along,
            )

    @cached_property
    def _along(self) -> Literal["depth", "distance"]:
        field, images = self.settings.field, dict.fromkeys(self.files, torch.empty(0))
        fields = field if isinstance(field, Mapping) else dict.fromkeys(images, field)
        return measured_along(Views(self.rig, images, self.alpha, fields))

    @property
    def _betas(self) -> list[str]:
        return [name for name in self.rig.betas(self.alpha) if name in self.files]

    def _propagated_bands(self, frame: Frame) -> list[str]:
        """Band names, as `band_names`, of a frame of several bands that does not say whose confidence is
        whose."""
        if not self.sequence or not 1 < len(frame.image) == len(self._betas):
            return []
        frames = [self.fusion.frames[name] for name in self._betas]
        images = [next(readable(of_one.__getitem__, range(len(of_one))), frame.image) for of_one in frames]
        return self._betas if all(len(image) == 1 for image in images) else []

    def _frame(self, i: int) -> Frame:
        if not self.sequence:
            images = ViewFiles(self.rig, {n: files[i] for n, files in self.files.items()}, alpha=self.alpha)
            network = _network(self.weights, precision=self.precision)
            how: dict[str, Any] = {"alpha": self.alpha, "network": network, "settings": self.settings}
            return fuse_frame(images, images.developed, **how)
        fusion = self.fusion
        return fusion.alone(i) if self.alone else fusion.frame(i, fusion.timeline.key_frames(), self._fetch)


def _plain(value: object) -> object:
    """Convert a value of a plan for JSON. Raises ValueError for fields of other families than arraygeom's."""
    if isinstance(value, Rig):
        return rig_text(value)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Tensor):
        return float(value)
    if isinstance(value, FuseSettings | NoiseLevel):
        return vars(value)
    if not dataclasses.is_dataclass(kind := type(value)):
        raise ValueError(f"a batch cannot write {value!r} to its file: give a dataclass, as Rectified() is")
    return {"kind": f"{kind.__module__}:{kind.__qualname__}", **vars(value)}


def _made(entries: dict[str, Any]) -> Any:
    """Rebuild the field or noise level of a part of a plan; other entries stay."""
    if entries.keys() == vars(NoiseLevel()).keys():
        return NoiseLevel(**entries)
    module, _, name = str(entries.get("kind")).partition(":")
    kind = getattr(sys.modules.get(module), name, None)  # a plan imports nothing
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        return entries
    return kind(**{name: value for name, value in entries.items() if name != "kind"})


def fuse_key(plan: Path, key: KeyFrame, modules: tuple[str, ...] = ()) -> None:
    """Task: fuse a key frame of the batch in the file `plan`, once `modules` are imported."""
    _planned(plan, plan.stat().st_mtime_ns, modules).fuse_key(key)


def fuse_one(plan: Path, i: int, inputs: str = "", modules: tuple[str, ...] = ()) -> None:
    """Task: fuse a frame of the batch in the file `plan`, once `modules` are imported."""
    _planned(plan, plan.stat().st_mtime_ns, modules).fuse_one(i, inputs)


def _differing(now: str, before: str) -> list[str]:
    """Names of settings (YAML) that differ from the former ones."""
    try:
        stated, former = load_yaml(now), load_yaml(before)
    except yaml.YAMLError:
        return ["unreadable"]
    if not isinstance(former, dict):
        return ["unreadable"]
    names = [name for name, value in stated.items() if former.get(name) != value]
    if names == ["settings"] and isinstance(former.get("settings"), dict):
        names = [n for n, value in stated["settings"].items() if former["settings"].get(n) != value]
    return names


def _digest(document: object) -> str:
    return hashlib.sha256(json.dumps(document).encode()).hexdigest()[:32]


@lru_cache(maxsize=2)
def _planned(plan: Path, time: int, modules: tuple[str, ...]) -> Batch:
    for name in modules:
        imported(name, "module")
    return Batch.from_json(plan.read_text(encoding="utf-8", errors="replace"), str(plan))


def find_images(text: str | Path, *, name: str = "") -> list[Path]:
    """Find the images of a folder, a pattern such as "a/mono_*.png", or one file.

    Args:
        text: folder, file, or pattern of a file's name in a folder.
        name: name of the camera, for messages; empty for none.

    Returns:
        Files in natural order, numbers in names counting as such; of a folder those with the suffix of an
        image, of a pattern all files that match, hidden ones left out; a single file may be hidden, and have
        any other suffix than a video's.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: for a text that ends in a video's suffix, and two files whose names differ in the
            suffix alone.
    """
    path = Path(text)
    label = f"{name}: " if name else ""
    if path.suffix.lower() in VIDEO_SUFFIXES:
        raise ValueError(f"{label}{path}: is a video, for `pat sequence` without a rig: save its frames")
    if path.is_dir():
        files = _images_in(path)
    else:
        files = [path] if path.exists() else [p for p in path.parent.glob(path.name) if p.is_file()]
    files = sorted((p for p in files if p == path or not p.name.startswith(".")), key=_natural)
    if not files:
        below = [str(p) for p in sorted(path.iterdir()) if _images_in(p)] if path.is_dir() else []
        advice = f"give a folder of images, such as {below[0]}" if below else "check the path"
        raise FileNotFoundError(f"{label}{path}: no image there: {advice}")
    frames: dict[str, Path] = {}
    for file in files:
        if (other := frames.setdefault(file.stem, file)) != file:
            pattern = file.with_name(f"*{file.suffix}")
            raise ValueError(f"{label}{other} and {file.name} are one frame: give a pattern, as '{pattern}'")
    return files


def _images_in(folder: Path) -> list[Path]:
    files = folder.iterdir() if folder.is_dir() else ()
    return [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()]


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(token), "") if token.isdecimal() else (-1, token) for token in re.split(r"(\d+)", path.name)]
