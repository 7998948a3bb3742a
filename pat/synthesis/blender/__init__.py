"""Scenes rendered by Blender (Cycles), for any calibrated rig.

bpy is imported when a scene is rendered: by `render` in a process of its own, by `render_here` in this one (for the
workers of a farm).
"""

from .client import RenderError, Worker, render
from .settings import Optics, RenderSettings
from .task import render_here

__all__ = ["Optics", "RenderError", "RenderSettings", "Worker", "render", "render_here"]
