"""Pairs and arrays on disk."""

from pat.data.indices import agreement, index_files, read_indices, write_indices
from pat.data.pairs import (
    PAPER_DISPARITY,
    Disparity,
    StereoCalibration,
    StereoPair,
    flickr_pairs,
    folder_pairs,
    kitti_pairs,
    middlebury_pairs,
    syntim_pairs,
)
from pat.data.patches import PatchGrid, scene_folders
from pat.data.scenes import Patch, RenderedScenes, ScenePatches, SceneShuffle, collate, default_chains
from pat.evaluation.protocols import MonoColourTask, mono_colour_task, reduce_by

__all__ = [
    "PAPER_DISPARITY",
    "Disparity",
    "MonoColourTask",
    "Patch",
    "PatchGrid",
    "RenderedScenes",
    "ScenePatches",
    "SceneShuffle",
    "StereoCalibration",
    "StereoPair",
    "agreement",
    "collate",
    "default_chains",
    "flickr_pairs",
    "folder_pairs",
    "index_files",
    "kitti_pairs",
    "middlebury_pairs",
    "mono_colour_task",
    "read_indices",
    "reduce_by",
    "scene_folders",
    "syntim_pairs",
    "write_indices",
]
