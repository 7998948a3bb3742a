"""Lens models, a file each family: maps between directions, undistorted and distorted points."""
