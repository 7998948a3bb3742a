"""Scenes rendered by Blender (Cycles), for any calibrated rig.

Blender runs as a process of its own, in a Python environment of its own (`environment`), for each scene.
"""

from .settings import RenderSettings
from .task import render

__all__ = ["RenderSettings", "render"]
