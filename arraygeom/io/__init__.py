"""Rig files: one module a format, one registry."""
