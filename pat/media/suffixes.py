"""Suffixes of image and video files. Imports nothing: the command line needs them before torch."""

RAW_SUFFIXES = {".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".orf", ".rw2", ".pef"}
"""Suffixes of cameras' raw files."""
PHOTO_SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".ppm"}
"""Suffixes of photographs among other files: a .pgm is a mask or a disparity map as often."""
IMAGE_SUFFIXES = PHOTO_SUFFIXES | RAW_SUFFIXES | {".pgm", ".pnm", ".heic", ".heif"}
VIDEO_SUFFIXES = {".mp4", ".mkv", ".mov", ".avi", ".m4v", ".webm"}
