"""Scenes rendered by Blender (Cycles), for any calibrated rig.

Nothing here imports bpy until a scene is rendered in this very process: `render` does so in a process of its own,
`render_here` in this one (for the workers of a farm).
"""

from .client import RenderError, Worker, render
from .settings import Optics, RenderSettings
from .task import render_here

__all__ = ["Optics", "RenderError", "RenderSettings", "Worker", "render", "render_here"]
