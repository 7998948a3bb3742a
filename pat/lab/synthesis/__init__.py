"""Scenes to images of arrays, with ground truth."""
