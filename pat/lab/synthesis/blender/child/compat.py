"""Differences between Blender versions, by feature detection; the only import of bpy."""

from __future__ import annotations

import importlib
from typing import Any

LIBRARIES = "libx11-6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libgl1"
"""Debian packages that `import bpy` needs (Cycles needs no more)."""


def load() -> Any:
    """Import the module bpy.

    Raises:
        ValueError: where bpy cannot be imported, in one line; it names the missing module, or the
            command that installs missing libraries of the system.
    """
    try:
        return importlib.import_module("bpy")
    except ModuleNotFoundError as error:
        raise ValueError(f"Blender's environment has no {error.name}: make it again") from None
    except ImportError as error:
        library = str(error).partition(":")[0]
        raise ValueError(f"Blender needs {library} of the system: apt-get install -y {LIBRARIES}") from None


def new_scene(bpy: Any) -> Any:
    """Replace Blender's data by an empty scene at default settings. References to former data become invalid.

    Returns:
        Blender's scene, with a world.
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("world")
    use_nodes(scene.world)
    return scene


def use_nodes(item: Any) -> None:
    """Enable nodes of a material or a world where they are off by default (before 5.0)."""
    if item.node_tree is None:
        item.use_nodes = True


def write_layers(scene: Any) -> None:
    """Set a scene of Blender, in place, to render to one multi-layer float EXR file in one part.

    Files in several parts fail if pixels are not square (Blender 5.0).
    """
    images = scene.render.image_settings
    if hasattr(images, "media_type"):
        images.media_type = "MULTI_LAYER_IMAGE"
    images.file_format = "OPEN_EXR_MULTILAYER"
    images.color_depth = "32"
    images.exr_codec = "ZIP"
    if hasattr(images, "use_exr_interleave"):
        images.use_exr_interleave = True


def factor(node: Any) -> Any:
    """Return the single-valued output of a texture node: 'Factor', 'Fac' before 5.0, or its first."""
    outputs = node.outputs
    return outputs.get("Factor") or outputs.get("Fac") or outputs[0]
