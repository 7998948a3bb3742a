"""One scene, rendered in this process."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom.camera import Camera
from arraygeom.rig import Rig

from ...support.schema import to_document
from ..check import check_views
from ..flow import flow
from ..rendered import RENDER_FILE, Rendered, RenderedFrame, frame_file, save_frame
from ..scene import Scene
from ..shapes import inside
from . import compat
from .lens import Lens, lens_for
from .probe import refuse_eevee
from .settings import Optics, RenderSettings
from .studio import NOTHING, Studio

_RATE = 30.0
_SHARED_MEMORY = Path("/dev/shm")
_SCRATCH = "pat-render-"


class Shot(NamedTuple):
    """One frame to render: camera, number, time and interval to the next, seconds."""

    camera: str
    number: int
    time: float
    step: float


def render_here(scene: Scene, rig: Rig, out: Path, *, settings: RenderSettings) -> Rendered:
    """Like `pat.synthesis.blender.render`, in this process, which imports bpy. Raises ValueError."""
    out = Path(out)
    if out.exists():
        raise ValueError(f"{out} exists: give a new folder, or remove it first")
    if settings.engine == "eevee":
        refuse_eevee()
    rig, started = fitted(rig, settings), time.monotonic()
    lenses = {name: lens_for(camera, name) for name, camera in rig.cameras.items()}
    planned = shots(rig, settings)
    refuse_inside(scene, rig, planned)
    with _staged(out) as folder, _scratch() as scratch, closing(Studio(scene, settings, scratch)) as studio:
        files: dict[str, list[dict[str, Any]]] = {name: [] for name in rig.names}
        first: dict[str, RenderedFrame] = {}
        for shot in planned:
            frame = take(studio, rig[shot.camera], lenses[shot.camera], shot)
            file = frame_file(rig, shot.camera, shot.number)
            save_frame(folder / file, frame)
            files[shot.camera].append({"file": file, "time": shot.time})
            first.setdefault(shot.camera, frame)
        rig.save(folder / "rig.yaml")
        scene.save(folder / "scene.yaml")
        about = {
            "settings": to_document(settings),
            "versions": {"blender": studio.bpy.app.version_string, "pat": version("arraygeom-pat")},
            "seconds": round(time.monotonic() - started, 3),
            "frames": files,
            "check": check_views(rig, first, settings.limits).to_document(),
        }
        (folder / RENDER_FILE).write_text(json.dumps(about, indent=1), encoding="utf-8")
    return Rendered(out)


def fitted(rig: Rig, settings: RenderSettings) -> Rig:
    """The rig at the size that is rendered. Raises ValueError for optics of cameras it does not have."""
    for name in settings.optics:
        rig.require(name)
    if settings.width is None:
        return rig
    scale = settings.width / max(camera.hw[1] for camera in rig.cameras.values())
    for name, camera in rig.cameras.items():
        h, w = (max(round(n * scale), 4) for n in camera.hw)
        rig = rig if (h, w) == camera.hw else rig.resize(name, (h, w))
    return rig


def shots(rig: Rig, settings: RenderSettings) -> list[Shot]:
    """All frames in order: each camera from its time offset on, at its frame rate, for the duration."""
    planned = []
    for name, camera in rig.cameras.items():
        rate = camera.sensor.frame_rate or _RATE
        count = max(1, int(np.ceil(settings.duration * rate - 1e-9)))
        planned += [Shot(name, k, camera.sensor.time_offset + k / rate, 1 / rate) for k in range(count)]
    return planned


def refuse_inside(scene: Scene, rig: Rig, planned: list[Shot]) -> None:
    """Raises ValueError if a camera is inside an object when it takes a frame."""
    for shot in planned:
        centre = rig[shot.camera].centre.detach().cpu().double().numpy()
        for item in scene.objects:
            if inside(item, centre, shot.time):
                raise ValueError(
                    f"camera '{shot.camera}' is inside the object '{item.name}' at {shot.time:g} s: move one of them"
                )


def take(studio: Studio, camera: Camera, lens: Lens, shot: Shot) -> RenderedFrame:
    """One frame with the passes that the settings ask for. Raises ValueError if the camera sees nothing."""
    settings = studio.settings
    optics = settings.optics.get(shot.camera, Optics())
    colours = studio.colours(lens.pinhole, shot.time, optics, "rgb")
    exact = colours if _is_exact(settings, optics) else studio.geometry(lens.pinhole, shot.time)
    index = exact[compat.index_name(exact)].round().int()
    depth = torch.where(exact["Depth.Z"] < NOTHING, exact["Depth.Z"], torch.inf)
    if not (index > 0).any():
        raise ValueError(f"camera '{shot.camera}' sees nothing of the scene at {shot.time:g} s: rotate it or move it")
    frame = RenderedFrame(
        time=shot.time,
        rgb=lens.resampled(_stack(colours, "Combined", "RGB")),
        depth=lens.depth(depth, index),
        index=lens.nearest(index[None].float())[0].int(),
    )
    return dataclasses.replace(frame, **_further(studio, camera, lens, shot, optics, frame, colours, exact))


def _further(
    studio: Studio,
    camera: Camera,
    lens: Lens,
    shot: Shot,
    optics: Optics,
    frame: RenderedFrame,
    colours: dict[str, Tensor],
    exact: dict[str, Tensor],
) -> dict[str, Any]:
    """The passes beyond colour, depth and index."""
    wanted, found = studio.settings.passes, {}
    if "normals" in wanted:
        found["normals"] = _normals(lens.nearest(_stack(exact, "Normal", "XYZ")), camera)
    if "flow" in wanted:
        found["flow"] = flow(studio.scene, camera, frame, shot.step)
    if "alpha" in wanted:
        found["alpha"] = lens.resampled(colours["Combined.A"][None]).clamp(0, 1)
    if "nir" in wanted:
        infrared = studio.colours(lens.pinhole, shot.time, optics, "nir")
        found["nir"] = lens.resampled(infrared["Combined.R"][None])
    return found


def _is_exact(settings: RenderSettings, optics: Optics) -> bool:
    """Whether an image's own depth and normals are exact: no blur, no normals asked for, and rendered by Cycles."""
    blurred = optics.f_number is not None or optics.shutter is not None
    return not blurred and settings.engine == "cycles" and "normals" not in settings.passes


def _normals(world: Float[Tensor, "3 h w"], camera: Camera) -> Float[Tensor, "3 h w"]:
    local = torch.einsum("ij,jhw->ihw", camera.R.to(world), world)
    return local / local.norm(dim=0, keepdim=True).clamp(min=1e-6)


def _stack(channels: dict[str, Tensor], name: str, letters: str) -> Tensor:
    return torch.stack([channels[f"{name}.{letter}"] for letter in letters])


@contextmanager
def _staged(out: Path) -> Iterator[Path]:
    """A folder beside `out` that is renamed to it when complete."""
    out.parent.mkdir(parents=True, exist_ok=True)
    folder = out.with_name(f".{out.name}-{uuid4().hex[:8]}.part")
    folder.mkdir()
    try:
        yield folder
        folder.rename(out)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _scratch() -> Iterator[Path]:
    """A temporary folder, in memory if possible, for the files that Blender writes.

    Its name holds the process number: those of processes that were killed are removed.
    """
    where = _SHARED_MEMORY if os.access(_SHARED_MEMORY, os.W_OK) else None
    for left in _SHARED_MEMORY.glob(f"{_SCRATCH}*") if where else ():
        owner = left.name.removeprefix(_SCRATCH).partition("-")[0]
        if owner.isdecimal() and not _alive(int(owner)):
            shutil.rmtree(left, ignore_errors=True)
    with tempfile.TemporaryDirectory(dir=where, prefix=f"{_SCRATCH}{os.getpid()}-") as folder:
        yield Path(folder)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
