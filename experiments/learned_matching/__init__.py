"""Learned features for matching, trained, no better than census in the same pipeline: docs/matching.md."""
