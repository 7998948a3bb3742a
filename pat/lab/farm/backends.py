"""Renderers of one scene from a seed: layered photographs, or Blender."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from arraygeom import Camera, Rig, stack
from arraygeom.pixels import HW
from pat.lab.synthesis.blender.environment import blender_python
from pat.lab.synthesis.blender.lens import lens_for
from pat.lab.synthesis.blender.settings import PRESETS, RenderSettings
from pat.lab.synthesis.blender.task import fitted, shots
from pat.lab.synthesis.blender.task import render as render_scene
from pat.lab.synthesis.check import CheckLimits, check_views
from pat.lab.synthesis.generators import generator_named
from pat.lab.synthesis.layered import LayeredScenes
from pat.lab.synthesis.patterns import patterns
from pat.lab.synthesis.photos import PhotoBank
from pat.lab.synthesis.rendered import RENDER_FILE, RenderedFrame, frame_file, save_frame
from pat.lab.synthesis.rig_distribution import RigDistribution
from pat.lab.synthesis.rigs import RigBatch, in_frame_of
from pat.media.colour import linear_from_srgb
from pat.support.schema import check_fields, from_document, near

FARTHEST = 50.0
"""Largest far bound of layered scenes, in multiples of the near one."""

Renderer = Callable[[int, Path], None]
"""Function of a seed and a folder that makes the folder, and renders and checks a scene into it."""


@dataclass(frozen=True, kw_only=True)
class LayeredSettings:
    """Settings of layered scenes; the rig's first camera is alpha.

    Attributes:
        photos: folders of images for textures; empty for patterns alone.
        edge: longest side, in pixels, that images are reduced to; 32 or more.
        layers: least and greatest number of planes, 1 or more.
        oversampling: samples in a pixel along each axis, 1 or more.

    Raises:
        ValueError: for values below these bounds, and layers out of order.
    """

    photos: tuple[Path, ...] = ()
    edge: int = 512
    layers: tuple[int, int] = (5, 12)
    oversampling: int = 2

    def __post_init__(self) -> None:
        check_fields(self, "edge", 32)
        check_fields(self, "oversampling", 1)
        if not 1 <= self.layers[0] <= self.layers[1]:
            raise ValueError(f"layers must be two numbers, at least 1 and in order, got {self.layers}")

    def images(self, rig: Rig) -> list[HW]:
        """List the sizes of a scene's images.

        Returns:
            (height, width) of each camera's image, in the rig's order.

        Raises:
            ValueError: as `rig_from_alpha`.
        """
        return [camera.hw for camera in rig_from_alpha(rig).cameras]

    def renderer(self, rig: Rig, limits: CheckLimits) -> Renderer:
        """Prepare a renderer for a rig, with the photographs loaded.

        Args:
            rig: rig to render; its first camera is alpha.
            limits: limits of the self-check, whose result is stored with a scene; one that fails is, too.

        Returns:
            A function that renders the scene of a seed into a new folder, `render(seed, out)`; it raises
            OSError if there is one (FileExistsError), or a file cannot be written.

        Raises:
            ValueError: as `rig_from_alpha`, and if `photos` hold no image that is read (`read_photographs`).
            OSError: as `read_photographs`.
        """
        rig_batch = rig_from_alpha(rig)
        if self.photos:
            bank = PhotoBank.load(*self.photos, max_edge=self.edge)
        else:
            bank = PhotoBank(patterns(np.random.default_rng(0), 60))
        scenes = LayeredScenes(bank, RigDistribution(), hw=rig_batch.cameras[0].hw, layers=self.layers)

        def render(seed: int, out: Path) -> None:
            started = time.monotonic()
            generator = torch.Generator().manual_seed(seed)
            batch = scenes.render(rig_batch, generator, oversampling=self.oversampling)
            frames = {
                name: RenderedFrame(time=0.0, rgb=linear_from_srgb(image)[0], depth=depth[0], index=index[0])
                for name, image, depth, index in zip(rig.names, batch.images, batch.depth, batch.index)
            }
            files = {name: frame_file(rig, name) for name in rig.names}
            out.mkdir(parents=True)
            rig.save(out / "rig.yaml")
            for name, frame in frames.items():
                save_frame(out / files[name], frame)
            about = {
                "settings": {"backend": "layered"},
                "versions": {"pat": version("arraygeom-pat"), "torch": torch.__version__},
                "seconds": round(time.monotonic() - started, 3),
                "frames": {name: [{"file": file, "time": 0.0}] for name, file in files.items()},
                "check": check_views(rig, frames, limits),
            }
            (out / RENDER_FILE).write_text(json.dumps(about, indent=1), encoding="utf-8")

        return render


@dataclass(frozen=True, kw_only=True)
class BlenderSettings:
    """Settings of Blender's scenes.

    Attributes:
        generator: "abstract", "photographs", or your own "module:function".
        photos: folder of images, for "photographs" only.
        preset: name of a preset of render settings.
        settings: entries of `RenderSettings` that differ from the preset, and from one thread.

    Raises:
        ValueError: for a generator without its `photos` or with photos it does not take, an unknown
            generator (your own is not imported yet), another preset, and invalid settings.
    """

    generator: str = "abstract"
    photos: Path | None = None
    preset: Literal["fast", "paper"] = "fast"
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if (self.generator == "photographs") != (self.photos is not None):
            raise ValueError("the generator 'photographs' needs a folder `photos`, no other one takes it")
        if ":" not in self.generator:
            generator_named(self.generator)
        self.render_settings()

    def render_settings(self) -> RenderSettings:
        """Combine preset and own entries, with one thread by default: a farm has one worker for each core.

        Raises:
            ValueError: naming the entry, for an invalid one, and for another preset.
        """
        if self.preset not in PRESETS:
            raise ValueError(f"no preset '{self.preset}'{near(self.preset, PRESETS)}")
        settings = {**PRESETS[self.preset], "threads": 1, **self.settings}
        return from_document(RenderSettings, settings, "settings")

    def images(self, rig: Rig) -> list[HW]:
        """List the sizes of a scene's images, after the settings' `width`.

        Returns:
            (height, width) of each image, one for each camera and point in time.

        Raises:
            ValueError: as `lens_for`, and for a generator that cannot be imported.
        """
        generator_named(self.generator)
        for name, camera in rig.cameras.items():
            lens_for(camera, name)
        settings = self.render_settings()
        rig = fitted(rig, settings)
        return [rig[shot.camera].hw for shot in shots(rig, settings)]

    def renderer(self, rig: Rig, limits: CheckLimits) -> Renderer:
        """Prepare a renderer for a rig, which is not checked before a scene is rendered.

        Args:
            limits: limits of the self-check, in place of those in `settings`.

        Returns:
            A function that renders the scene of a seed into a new folder, `render(seed, out)`; it raises what
            the generator and `pat.lab.synthesis.blender.task.render` raise.

        Raises:
            ValueError: if Blender or OpenEXR is not installed, or the generator cannot be imported.
        """
        blender_python()
        generator, settings = generator_named(self.generator), replace(self.render_settings(), limits=limits)
        further = {} if self.photos is None else {"folder": self.photos}

        def render(seed: int, out: Path) -> None:
            scene = generator(seed, rig, moving=settings.duration, **further)
            render_scene(scene, rig, out, settings=settings)

        return render


def rig_from_alpha(rig: Rig) -> RigBatch:
    """Convert a rig to a batch of one, with the first camera's frame as the world.

    Returns:
        The batch, float64; a far bound beyond `FARTHEST` times near is cut.

    Raises:
        ValueError: for cameras that are not calibrated or have a lens model, and for a rig without a depth
            range.
    """
    for name, camera in rig.cameras.items():
        if not isinstance(camera, Camera):
            raise ValueError(f"camera '{name}' is not calibrated: rendering needs its K, R and t")
        if camera.distortion is not None:
            raise ValueError(f"camera '{name}' has a lens, layered scenes have none: use Blender, or omit it")
    if rig.depth is None:
        raise ValueError("the rig has no depth range: add `depth: [near, far]` in metres to its file")
    near, far = (float(d) for d in rig.depth)

    cameras = [c.to(torch.float64) for c in rig.cameras.values() if isinstance(c, Camera)]
    relative = [stack([in_frame_of(cameras[0], c)]) for c in cameras]
    bounds = (torch.tensor([d], dtype=torch.float64) for d in (near, min(far, FARTHEST * near)))
    return RigBatch(relative, *bounds)
