"""Scenes rendered by Blender (Cycles), for any calibrated rig.

bpy is imported when a scene is rendered: by `render` in a process of its own, by `render_here` in this one
(for the workers of a farm).
"""

from .settings import RenderSettings
from .task import render, render_here

__all__ = ["RenderSettings", "render", "render_here"]
