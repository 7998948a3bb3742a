"""Rendering of a scene by Blender, which runs as a process of its own in its own environment."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Mapping
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from arraygeom.camera import Camera

from ....support.schema import to_document
from ..scene import Motion, Scene
from ..shapes import mesh
from .environment import blender_python
from .settings import RenderSettings

NOTHING = 1e9
"""Depth above which the ray hit nothing."""

_FLIP = np.diag([1.0, -1.0, -1.0])
_SENSOR = 36.0
_SERVE = "import sys; sys.path.append(sys.argv[1]); from child.serve import serve; serve()"


class Studio:
    """Blender with one scene loaded, until `close`; renders frames of any pinhole camera at any time.

    Args:
        scratch: existing folder for temporary files.

    Attributes:
        version: Blender's version.

    Raises:
        ValueError: as `blender_python`, and for a texture whose image file is missing.
        KeyError: for an unknown shape.
        BrokenProcessPool: if Blender's process dies, as at another error in it.
    """

    def __init__(self, scene: Scene, settings: RenderSettings, scratch: Path):
        self.scene, self.settings, self.path = scene, settings, scratch / "layers.exr"
        shapes = [mesh(thing)._asdict() for thing in scene.objects]
        meshes = [{name: values.tolist() for name, values in shape.items()} for shape in shapes]
        entries = to_document(scene, defaults=True), to_document(settings, defaults=True)
        command = [blender_python(), "-I", "-B", "-c", _SERVE, str(Path(__file__).parent)]
        self.errors, pipe = scratch / "errors.txt", subprocess.PIPE
        with self.errors.open("w") as errors:
            self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=errors, text=True)
        try:
            self.version = self._ask(scene=entries[0], settings=entries[1], meshes=meshes)["version"]
        except BaseException:
            self.close()
            raise

    def channels(self, camera: Camera, time: float, spectrum: Literal["rgb", "nir"]) -> dict[str, Tensor]:
        """Render one frame.

        Args:
            camera: pinhole camera on the CPU, without gradient; skew and a lens model are ignored.
            time: seconds, for the objects' motion.
            spectrum: "rgb" for colours, "nir" for near infrared.

        Returns:
            Channels (h, w), float32: "Combined.R", ".G" and ".B", near infrared in all three; "Depth.Z",
            metres along the optical axis, above `NOTHING` where a ray hit nothing; and by `index_name` the
            object's number from 1, or 0.

        Raises:
            ValueError: for what Blender refuses, in one line; no further frame can be rendered then.
            BrokenProcessPool: if its process dies.
        """
        places = [_place(thing.motion, time) for thing in self.scene.objects]
        self._ask(places=places, spectrum=spectrum, path=str(self.path), **_aim(camera))
        channels = read_layers(self.path)
        self.path.unlink()
        return channels

    def close(self) -> None:
        """End Blender's process."""
        self.process.kill()
        self.process.communicate()

    def _ask(self, **request: Any) -> dict[str, str]:
        """Send a request. Raises ValueError with Blender's own sentence, BrokenProcessPool if it dies."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        try:
            self.process.stdin.write(json.dumps(request) + "\n")
            self.process.stdin.flush()
        except BrokenPipeError:
            pass
        answer = self.process.stdout.readline()
        if not answer:
            status = f"Blender's process died with status {self.process.wait()}"
            last = self.errors.read_text().splitlines()[-1:]
            raise BrokenProcessPool(": ".join([status, *last]))
        answered: dict[str, str] = json.loads(answer)
        if "error" in answered:
            raise ValueError(answered["error"])
        return answered


def _aim(camera: Camera) -> dict[str, Any]:
    """Settings of Blender's image, camera and pose, for a sensor of `_SENSOR` mm: it refuses under 1 mm."""
    (h, w), K = camera.hw, camera.K
    fx, fy = float(K[0, 0]), float(K[1, 1])
    across, down = max(1.0, fy / fx), max(1.0, fx / fy)
    return {
        "image": {
            "resolution_x": w,
            "resolution_y": h,
            "resolution_percentage": 100,
            "pixel_aspect_x": across,
            "pixel_aspect_y": down,
        },
        "camera": {
            "sensor_fit": "HORIZONTAL",
            "sensor_width": _SENSOR,
            "lens": fx * _SENSOR / w,
            "shift_x": (w / 2 - 0.5 - float(K[0, 2])) / w,
            "shift_y": (float(K[1, 2]) + 0.5 - h / 2) * (down / across) / w,
            "clip_start": 1e-3,
            "clip_end": 1e5,
        },
        "pose": {"matrix_world": _blender_pose(camera).T.tolist()},
    }


def read_layers(path: Path) -> dict[str, Tensor]:
    """Read the channels of a multi-layer EXR file that Blender wrote.

    Returns:
        Channels (h, w), float32, by pass and channel without the layer, such as "Combined.R".

    Raises:
        ImportError: without OpenEXR. RuntimeError: for a file that it cannot read.
    """
    import OpenEXR

    layers: dict[str, Tensor] = {}
    with OpenEXR.File(str(path), separate_channels=True) as file:
        for layer in file.parts:
            for name, channel in layer.channels.items():
                short = name.split(".", 1)[1] if name.count(".") > 1 else name
                layers[short] = torch.from_numpy(np.array(channel.pixels, dtype=np.float32))
    return layers


def _blender_pose(camera: Camera) -> Float[NDArray, "4 4"]:
    """World from camera in Blender's axes: x right, y up, z back."""
    M = np.eye(4)
    M[:3, :3] = camera.R.numpy().T @ _FLIP
    M[:3, 3] = camera.centre.numpy()
    return M


def _place(motion: Motion, time: float) -> tuple[list[float], list[float], list[float]]:
    """Location, quaternion (w, x, y, z) and scale of an object at a time."""
    R, position, extent = motion.at(time)
    x, y, z, w = Rotation.from_matrix(R).as_quat()
    return position.tolist(), [w, x, y, z], (extent / np.asarray(motion.keys[0].extent)).tolist()


def index_name(channels: Mapping[str, Any]) -> str:
    """Return the name of the object-index channel among those of a file.

    Raises:
        StopIteration: if there is none.
    """
    return next(name for name in ("Object Index.X", "IndexOB.X") if name in channels)
