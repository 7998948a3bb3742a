"""Pairs and arrays on disk."""

from pat.data.indices import agreement, index_files, read_indices, write_indices
from pat.data.pairs import PAPER_DISPARITY, Disparity, StereoPair, folder_pairs, middlebury_pairs
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
    "StereoPair",
    "agreement",
    "collate",
    "default_chains",
    "folder_pairs",
    "index_files",
    "middlebury_pairs",
    "read_indices",
    "scene_folders",
    "write_indices",
]
