"""Pairs and arrays on disk."""

from pat.data.pairs import (
    PAPER_DISPARITY,
    Calibration,
    Disparity,
    StereoPair,
    flickr_pairs,
    folder_pairs,
    kitti_pairs,
    middlebury_pairs,
    syntim_pairs,
)
from pat.data.protocol import MonoColourTask, mono_colour_task, reduce_by

__all__ = [
    "PAPER_DISPARITY",
    "Calibration",
    "Disparity",
    "MonoColourTask",
    "StereoPair",
    "flickr_pairs",
    "folder_pairs",
    "kitti_pairs",
    "middlebury_pairs",
    "mono_colour_task",
    "reduce_by",
    "syntim_pairs",
]
