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
from pat.data.patches import PatchGrid
from pat.data.scenes import Patch, ScenePatches, SceneShuffle, collate, default_chains
from pat.data.windows import scene_folders

__all__ = [
    "PAPER_DISPARITY",
    "Disparity",
    "Patch",
    "PatchGrid",
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
    "read_indices",
    "scene_folders",
    "syntim_pairs",
    "write_indices",
]
