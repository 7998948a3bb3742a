"""Scenes to pictures of arrays, with ground truth."""
