"""Looking at scenes: contact sheets of a generator, animations as video, near infrared beside colour."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from arraygeom.atomic import write_atomically
from arraygeom.rig import Rig

from ..media.images import write_image
from .blender import RenderSettings, Worker
from .image_files import coded, light
from .rendered import Rendered, RenderedFrame
from .scene import Scene


def contact_sheet(
    scenes: Sequence[Scene], rig: Rig, out: Path, *, settings: RenderSettings, columns: int = 6
) -> list[Rendered]:
    """Render scenes into folders under `out`, and the first camera's images into `out/sheet.png`."""
    with Worker() as worker:
        done = [_rendered(worker, s, rig, out / f"{s.generator}-{s.seed:04d}", settings) for s in scenes]
    write_image(out / "sheet.png", tiled([coded(r.frame(r.rig.names[0]).rgb) for r in done], columns))
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
    """The frames of a camera as an MP4 file, at its frame rate. Raises ValueError if there is only one."""
    count = rendered.frames(camera)
    if count < 2:
        raise ValueError(f"camera '{camera}' has one frame: render with a duration")
    rate, (h, w) = rendered.rig[camera].sensor.frame_rate or 30.0, rendered.rig[camera].hw
    with write_atomically(path) as temporary:
        writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter.fourcc(*"mp4v"), rate, (w, h))
        for k in range(count):
            image = coded(rendered.frame(camera, k).rgb).mul(255).round().byte()
            writer.write(np.ascontiguousarray(image.flip(0).movedim(0, -1).numpy()))
        writer.release()


def _rendered(worker: Worker, scene: Scene, rig: Rig, folder: Path, settings: RenderSettings) -> Rendered:
    return Rendered(folder) if folder.exists() else worker.render(scene, rig, folder, settings=settings)


def _with_infrared(frame: RenderedFrame) -> list[Tensor]:
    grey = [coded(light(frame, "bw")), coded(light(frame, "nir"))]
    return [coded(frame.rgb), *(g.expand(3, -1, -1) for g in grey)]
