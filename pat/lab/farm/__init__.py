"""Rendering of many scenes: configuration, renderers, and the job that renders missing scenes."""
