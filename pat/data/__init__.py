"""Pairs and arrays on disk."""

from pat.data.indices import agreement, index_files, read_indices, write_indices
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
from pat.data.patches import Patches, scene_folders
from pat.data.scenes import Patch, RenderedScenes, ScenePatches, SceneShuffle, collate, default_chains

__all__ = [
    "PAPER_DISPARITY",
    "Calibration",
    "Disparity",
    "Patch",
    "Patches",
    "RenderedScenes",
    "ScenePatches",
    "SceneShuffle",
    "StereoPair",
    "agreement",
    "collate",
    "default_chains",
    "flickr_pairs",
    "folder_pairs",
    "index_files",
    "kitti_pairs",
    "middlebury_pairs",
    "read_indices",
    "scene_folders",
    "syntim_pairs",
    "write_indices",
]
