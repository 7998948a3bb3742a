"""Scenes rendered by Blender (Cycles), for any calibrated rig.

bpy is imported when a scene is rendered: by `render` in a separate process, by `render_here` in this one (for
a farm's workers).
"""

from .settings import RenderSettings
from .task import render, render_here

__all__ = ["RenderSettings", "render", "render_here"]
