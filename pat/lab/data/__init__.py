"""Stereo pairs and rendered scenes on disk."""

from pat.lab.data.pairs import PAPER_DISPARITY, Disparity, StereoPair, folder_pairs, middlebury_pairs
from pat.lab.data.windows import scene_folders

__all__ = ["PAPER_DISPARITY", "Disparity", "StereoPair", "folder_pairs", "middlebury_pairs", "scene_folders"]
