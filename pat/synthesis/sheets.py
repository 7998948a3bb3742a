"""Looking at scenes: contact sheets of a generator, animations as video, near infrared beside colour."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from arraygeom.rig import Rig

from ..media.colour import srgb_image
from ..media.images import write_image
from ..media.video import write_video
from .blender import RenderSettings, Worker
from .image_files import light
from .rendered import Rendered, RenderedFrame
from .scene import Scene


def contact_sheet(
    scenes: Sequence[Scene], rig: Rig, out: Path, *, settings: RenderSettings, columns: int = 6
) -> list[Rendered]:
    """Render scenes into folders under `out`, and the first camera's images into `out/sheet.png`."""
    with Worker() as worker:
        done = [_rendered(worker, s, rig, out / f"{s.generator}-{s.seed:04d}", settings) for s in scenes]
    write_image(out / "sheet.png", tiled([srgb_image(r.frame(r.rig.names[0]).rgb) for r in done], columns))
    return done


def tiled(images: Sequence[Float[Tensor, "c _ _"]], columns: int) -> Float[Tensor, "c h w"]:
    """Images in rows, each in a cell as large as the largest."""
    h, w = (max(p.shape[i] for p in images) for i in (1, 2))
    cells = [pad(p, (0, w - p.shape[2], 0, h - p.shape[1])) for p in images]
    cells += [torch.zeros_like(cells[0])] * (-len(cells) % columns)
    rows = [torch.cat(cells[i : i + columns], 2) for i in range(0, len(cells), columns)]
    return torch.cat(rows, 1)


def infrared_sheet(rendered: Rendered, path: Path) -> None:
    """Each camera in a row: colour, its luminance, near infrared."""
    rows = [_with_infrared(rendered.frame(name)) for name in rendered.rig.names]
    write_image(path, tiled([p for row in rows for p in row], 3))


def video(rendered: Rendered, camera: str, path: Path) -> None:
    """The frames of a camera as a video (.mp4, .mkv), at its frame rate. Raises ValueError if there is only one."""
    count = rendered.frames(camera)
    if count < 2:
        raise ValueError(f"camera '{camera}' has one frame: render with a duration")
    frames = (srgb_image(rendered.frame(camera, k).rgb) for k in range(count))
    write_video(path, frames, rate=rendered.rig[camera].sensor.frame_rate or 30.0)


def _rendered(worker: Worker, scene: Scene, rig: Rig, folder: Path, settings: RenderSettings) -> Rendered:
    return Rendered(folder) if folder.exists() else worker.render(scene, rig, folder, settings=settings)


def _with_infrared(frame: RenderedFrame) -> list[Tensor]:
    grey = [srgb_image(light(frame, "bw")), srgb_image(light(frame, "nir"))]
    return [srgb_image(frame.rgb), *(g.expand(3, -1, -1) for g in grey)]
