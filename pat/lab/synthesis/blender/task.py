"""Rendering of one scene."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from uuid import uuid4

import numpy as np
import torch

from arraygeom.rig import Rig

from ....support.schema import to_document
from ..check import check_views
from ..rendered import RENDER_FILE, Rendered, RenderedFrame, frame_file, save_frame
from ..scene import Scene
from ..shapes import inside
from .lens import Lens, lens_for
from .settings import RenderSettings
from .studio import NOTHING, Studio, index_name

_RATE = 30.0


class Shot(NamedTuple):
    """One frame to render.

    Attributes:
        camera: name of the camera.
        number: number of the frame, from 0.
        time: time in seconds, the camera's time offset included.
    """

    camera: str
    number: int
    time: float


def render(scene: Scene, rig: Rig, out: Path, *, settings: RenderSettings) -> Rendered:
    """Render a scene of a rig into the new folder `out`, atomically.

    Args:
        rig: calibrated cameras to render.

    Returns:
        The rendered folder, with the outcome of the self-check in `about["check"]`; a scene that fails it is
        kept.

    Raises:
        ValueError: in one line, if `out` exists or the scene cannot be rendered (such as a camera that
            `lens_for` refuses, that is inside an object or sees nothing, or a missing library).
        BrokenProcessPool: if Blender's process dies.
        OSError: if a file cannot be written.
    """
    out = Path(out)
    if out.exists():
        raise ValueError(f"{out} exists: give a new folder, or remove it first")
    rig, started = fitted(rig.to("cpu"), settings), time.monotonic()
    lenses = {name: lens_for(camera, name) for name, camera in rig.cameras.items()}
    planned = shots(rig, settings)
    refuse_inside(scene, rig, planned)
    with _staged(out) as folder, _studio(scene, settings, out.parent) as studio:
        files: dict[str, list[dict[str, Any]]] = {name: [] for name in rig.names}
        first: dict[str, RenderedFrame] = {}
        for shot in planned:
            frame = take(studio, lenses[shot.camera], shot)
            file = frame_file(rig, shot.camera, shot.number)
            save_frame(folder / file, frame)
            files[shot.camera].append({"file": file, "time": shot.time})
            first.setdefault(shot.camera, frame)
        rig.save(folder / "rig.yaml")
        scene.save(folder / "scene.yaml")
        about = {
            "settings": to_document(settings),
            "versions": {"blender": studio.version, "pat": version("arraygeom-pat")},
            "seconds": round(time.monotonic() - started, 3),
            "frames": files,
            "check": check_views(rig, first, settings.limits),
        }
        (folder / RENDER_FILE).write_text(json.dumps(about, indent=1), encoding="utf-8")
    return Rendered(out)


def fitted(rig: Rig, settings: RenderSettings) -> Rig:
    """Return the rig resized by one factor so that its widest image has the settings' width; the rig itself
    if that is None.

    Sides are rounded, to at least 4 pixels.
    """
    if settings.width is None:
        return rig
    scale = settings.width / max(camera.hw[1] for camera in rig.cameras.values())
    for name, camera in rig.cameras.items():
        h, w = (max(round(n * scale), 4) for n in camera.hw)
        rig = rig if (h, w) == camera.hw else rig.resize(name, (h, w))
    return rig


def shots(rig: Rig, settings: RenderSettings) -> list[Shot]:
    """List the frames to render: each camera from its time offset on, at its frame rate, for the duration.

    A camera without a frame rate has 30 frames a second.

    Returns:
        Frames by camera, then by time; at least one for each camera.
    """
    planned = []
    for name, camera in rig.cameras.items():
        rate = camera.sensor.frame_rate or _RATE
        count = max(1, int(np.ceil(settings.duration * rate - 1e-9)))
        planned += [Shot(name, k, camera.sensor.time_offset + k / rate) for k in range(count)]
    return planned


def refuse_inside(scene: Scene, rig: Rig, planned: list[Shot]) -> None:
    """Check that no camera (all calibrated) is inside an object when it takes one of the frames `planned`.

    Raises:
        ValueError: naming camera and object, if one is.
    """
    for shot in planned:
        centre = rig[shot.camera].centre.detach().cpu().double().numpy()
        for item in scene.objects:
            if inside(item, centre, shot.time):
                where = f"inside the object '{item.name}' at {shot.time:g} s"
                raise ValueError(f"camera '{shot.camera}' is {where}: move one of them")


def take(studio: Studio, lens: Lens, shot: Shot) -> RenderedFrame:
    """Render one frame of a camera, resampled to its lens.

    Args:
        lens: lens of the shot's camera.

    Returns:
        The frame at the true camera's pixels, with near infrared if the studio's settings ask for it.

    Raises:
        ValueError: if the camera sees nothing; also as `Studio.channels`.
        BrokenProcessPool: if Blender's process dies.
    """
    rendered = studio.channels(lens.pinhole, shot.time, "rgb")
    index = rendered[index_name(rendered)].round().int()
    depth = torch.where(rendered["Depth.Z"] < NOTHING, rendered["Depth.Z"], torch.inf)
    if not (index > 0).any():
        raise ValueError(f"camera '{shot.camera}' sees nothing at {shot.time:g} s: rotate it or move it")
    nir = None
    if studio.settings.infrared:
        nir = lens.resampled(studio.channels(lens.pinhole, shot.time, "nir")["Combined.R"][None])
    return RenderedFrame(
        time=shot.time,
        rgb=lens.resampled(torch.stack([rendered[f"Combined.{letter}"] for letter in "RGB"])),
        depth=lens.depth(depth, index),
        index=lens.nearest(index[None].float())[0].int(),
        nir=nir,
    )


@contextmanager
def _staged(out: Path) -> Iterator[Path]:
    """Folder beside `out` that is renamed to it when complete."""
    out.parent.mkdir(parents=True, exist_ok=True)
    folder = out.with_name(f".{out.name}-{uuid4().hex[:8]}.part")
    folder.mkdir()
    try:
        yield folder
        folder.rename(out)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _studio(scene: Scene, settings: RenderSettings, beside: Path) -> Iterator[Studio]:
    """Blender with a scene, and a temporary folder within `beside` for the files that it writes."""
    with TemporaryDirectory(dir=beside) as scratch, closing(Studio(scene, settings, Path(scratch))) as studio:
        yield studio
