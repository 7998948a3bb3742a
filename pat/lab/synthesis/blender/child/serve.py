"""Answers to a studio's requests: lines of JSON in, one with a scene, then one for each frame; lines out."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

from . import compat
from .build import build


def serve() -> None:
    """Answer requests on standard input until it ends, or one raises an error, which is the last answer.

    An answer is a line of JSON: {"version": Blender's} to the first, {} to others, {"error": one line}.
    """
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # Blender prints there, past Python
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    requests = (json.loads(line, object_hook=lambda it: SimpleNamespace(**it)) for line in sys.stdin)
    for answer in _answers(requests):
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def _answers(requests: Iterator[Any]) -> Iterator[dict[str, str]]:
    try:
        stage = Stage(next(requests))
        yield {"version": stage.bpy.app.version_string}
        for request in requests:
            stage.render(request)
            yield {}
    except (LookupError, RuntimeError, TypeError, ValueError) as error:
        kind = "" if type(error) is ValueError else f"{type(error).__name__}: "
        yield {"error": kind + " ".join(str(error).split())}


class Stage:
    """Blender with one scene loaded.

    Args:
        request: `scene`, `meshes` and `settings`, as the studio sends them.

    Raises:
        ValueError: if bpy cannot be imported; it and other errors as `build`.
    """

    def __init__(self, request: Any):
        self.scene, self.settings = request.scene, request.settings
        self.bpy = compat.load()
        self.blender = compat.new_scene(self.bpy)
        self.camera = self.bpy.data.objects.new("camera", self.bpy.data.cameras.new("camera"))
        self.blender.collection.objects.link(self.camera)
        self.blender.camera = self.camera
        self.built = build(self.bpy, self.scene, request.meshes, self.blender.world)
        self._quality()

    def render(self, request: Any) -> None:
        """Render one frame (colours, depth, object index) to a multi-layer EXR file. Errors of Blender pass.

        Args:
            request: `places`, `spectrum`, `path`, `image`, `camera` and `pose`, as `Studio.channels` sends
                them; `path` is the file.
        """
        for item, place in zip(self.built.objects, request.places):
            item.location, item.rotation_quaternion, item.scale = place
        self.blender.frame_set(1)
        for item, values in (
            (self.blender.render, request.image),
            (self.camera.data, request.camera),
            (self.camera, request.pose),
        ):
            for name, value in vars(values).items():
                setattr(item, name, value)
        self.built.show(request.spectrum)
        self.blender.render.filepath = request.path
        self.bpy.ops.render.render(write_still=True)

    def _quality(self) -> None:
        s, render, cycles = self.settings, self.blender.render, self.blender.cycles
        render.engine = "CYCLES"
        cycles.device = "CPU"
        cycles.samples, cycles.use_adaptive_sampling, cycles.seed = s.samples, False, self.scene.seed % 2**31
        cycles.use_denoising = s.denoise != "none"
        cycles.denoiser = "OPENIMAGEDENOISE"
        cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
        cycles.denoising_quality = "HIGH" if s.denoise == "accurate" else "FAST"
        cycles.denoising_prefilter = "ACCURATE" if s.denoise == "accurate" else "FAST"
        self._light_paths()
        render.use_persistent_data = True
        render.dither_intensity = 0
        render.threads_mode = "FIXED" if s.threads else "AUTO"
        render.threads = s.threads or 1
        layer = self.blender.view_layers[0]
        layer.use_pass_z = layer.use_pass_object_index = True
        compat.write_layers(self.blender)

    def _light_paths(self) -> None:
        s, cycles = self.settings, self.blender.cycles
        glass = any(thing.material.transmission for thing in self.scene.objects)
        cycles.max_bounces = max(s.bounces, 6 if glass else 0)
        cycles.diffuse_bounces = cycles.glossy_bounces = s.bounces
        cycles.transmission_bounces = 6 if glass else 0
        cycles.caustics_reflective = cycles.caustics_refractive = False
        cycles.sample_clamp_indirect = 5
        cycles.use_light_tree = len(self.scene.lights) > 4
        cycles.use_fast_gi = s.fast_light
        cycles.fast_gi_method = "REPLACE"
        cycles.ao_bounces_render = 1
        self.blender.world.light_settings.distance = 0.15 * self.scene.depth[1]
