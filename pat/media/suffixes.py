"""Suffixes of image and video files. Nothing is imported: the command line needs them before torch."""

RAW_SUFFIXES = {".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".orf", ".rw2", ".pef"}
"""Of cameras' raw files."""
PHOTO_SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".ppm"}
"""Of photographs among other files: .pgm are masks and disparities as often."""
IMAGE_SUFFIXES = PHOTO_SUFFIXES | RAW_SUFFIXES | {".pgm", ".pnm", ".heic", ".heif"}
VIDEO_SUFFIXES = {".mp4", ".mkv", ".mov", ".avi", ".m4v", ".webm"}
