"""Rendering of a built scene: set the camera, render, read the passes."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from arraygeom.camera import Camera

from ..scene import Motion, Scene
from . import compat
from .build import BuiltScene, Spectrum, build
from .settings import RenderSettings

NOTHING = 1e9
"""Depth above which the ray hit nothing."""

_FLIP = np.diag([1.0, -1.0, -1.0])
_SENSOR = 36.0


class Studio:
    """Blender with one scene loaded; renders frames of any pinhole camera at any time.

    Args:
        scene: scene to render.
        settings: settings of rendering.
        scratch: existing folder for temporary files.

    Raises:
        ValueError: if Blender is not installed, or no GPU is usable for device "gpu".
    """

    def __init__(self, scene: Scene, settings: RenderSettings, scratch: Path):
        self.scene, self.settings, self.scratch = scene, settings, scratch
        self.bpy = compat.load()
        self.blender = compat.new_scene(self.bpy)
        self.camera = self.bpy.data.objects.new("camera", self.bpy.data.cameras.new("camera"))
        self.blender.collection.objects.link(self.camera)
        self.blender.camera = self.camera
        self.stage: BuiltScene = build(self.bpy, scene, self.blender.world)
        with quietly():  # naming a denoiser looks for GPUs, and complains of their absence
            self._quality()

    def channels(self, camera: Camera, time: float, spectrum: Spectrum) -> dict[str, Tensor]:
        """Render one frame.

        Args:
            camera: pinhole camera; a lens model is ignored.
            time: seconds, for the objects' motion.
            spectrum: "rgb" for colours, "nir" for near infrared.

        Returns:
            Channels (h, w), float32, by Blender's names: colours, depth, object index.
        """
        for item, thing in zip(self.stage.objects, self.scene.objects):
            _place(item, thing.motion, time)
        self.blender.frame_set(1)
        self._aim(camera)
        self.stage.show(spectrum)
        path = self.scratch / "layers.exr"
        self.blender.render.filepath = str(path)
        with quietly():
            self.bpy.ops.render.render(write_still=True)
        channels = read_layers(path)
        path.unlink()
        return channels

    def close(self) -> None:
        """Drop Blender's persistent data; until then one of its threads keeps half a core busy."""
        self.blender.render.use_persistent_data = False

    # Settings --------------------------------------------------------------------------------------------

    def _quality(self) -> None:
        s, render, cycles = self.settings, self.blender.render, self.blender.cycles
        render.engine = "CYCLES"
        cycles.device = "GPU" if s.device != "cpu" and self._gpu() else "CPU"
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

    def _gpu(self) -> bool:
        gpu = compat.use_gpu(self.bpy)
        if not gpu and self.settings.device == "gpu":
            raise ValueError("no GPU that Cycles can use was found: take device 'cpu' or 'auto'")
        return gpu

    # One image -----------------------------------------------------------------------------------------

    def _aim(self, camera: Camera) -> None:
        """Set Blender's camera, with a sensor 36 units wide for any camera: Blender refuses less
        than 1 mm."""
        data, render = self.camera.data, self.blender.render
        (h, w), K = camera.hw, camera.K
        fx, fy = float(K[0, 0]), float(K[1, 1])
        render.resolution_x, render.resolution_y, render.resolution_percentage = w, h, 100
        render.pixel_aspect_x, render.pixel_aspect_y = max(1.0, fy / fx), max(1.0, fx / fy)
        data.sensor_fit, data.sensor_width, data.lens = "HORIZONTAL", _SENSOR, fx * _SENSOR / w
        aspect = render.pixel_aspect_y / render.pixel_aspect_x
        data.shift_x = (w / 2 - 0.5 - float(K[0, 2])) / w
        data.shift_y = (float(K[1, 2]) + 0.5 - h / 2) * aspect / w
        data.clip_start, data.clip_end = 1e-3, 1e5
        self.camera.matrix_world = _blender_pose(camera).T.tolist()


def read_layers(path: Path) -> dict[str, Tensor]:
    """Read the channels of a multi-layer EXR file.

    Returns:
        Channels (h, w), float32, by `Pass.Channel`.

    Raises:
        ValueError: if OpenEXR is not installed.
    """
    try:
        import OpenEXR
    except ImportError:
        raise ValueError(f"rendering needs OpenEXR to read what Blender writes: {compat.INSTALL}") from None
    layers: dict[str, Tensor] = {}
    with OpenEXR.File(str(path), separate_channels=True) as file:
        for layer in file.parts:
            for name, channel in layer.channels.items():
                short = name.split(".", 1)[1] if name.count(".") > 1 else name
                layers[short] = torch.from_numpy(np.array(channel.pixels, dtype=np.float32))
    return layers


@contextmanager
def quietly() -> Iterator[None]:
    """Context manager that suppresses Blender's output, which bypasses Python's standard output."""
    sys.stdout.flush()
    former, sink = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 1)
        yield
    finally:
        os.dup2(former, 1)
        os.close(former)
        os.close(sink)


def _blender_pose(camera: Camera) -> Float[NDArray, "4 4"]:
    """World from camera in Blender's axes: x right, y up, z back."""
    M = np.eye(4)
    M[:3, :3] = camera.R.numpy().T @ _FLIP
    M[:3, 3] = camera.centre.numpy()
    return M


def _place(item: Any, motion: Motion, time: float) -> None:
    R, position, extent = motion.at(time)
    x, y, z, w = Rotation.from_matrix(R).as_quat()
    item.location = position.tolist()
    item.rotation_quaternion = [w, x, y, z]
    item.scale = (extent / np.asarray(motion.keys[0].extent)).tolist()
