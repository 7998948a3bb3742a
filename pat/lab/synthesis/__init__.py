"""Synthesis: scenes rendered as images of camera arrays, with ground truth."""
