"""Suffixes of image and video files. Nothing is imported: the command line needs them before torch."""

RAW_SUFFIXES = {".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".orf", ".rw2", ".pef"}
"""Of cameras' raw files."""
IMAGE_SUFFIXES = {".png", ".tif", ".tiff", ".jpg", ".jpeg", ".pgm", ".ppm", ".pnm", ".bmp", ".webp", ".heic", ".heif"}
IMAGE_SUFFIXES |= RAW_SUFFIXES
VIDEO_SUFFIXES = {".mp4", ".mkv", ".mov", ".avi", ".m4v", ".webm"}
