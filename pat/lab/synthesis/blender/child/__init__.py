"""Blender's side of a studio, with bpy, NumPy and the standard library alone: it runs in Blender's own Python
environment, as the package `child`, and imports nothing of the rest."""
