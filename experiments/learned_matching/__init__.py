"""Learned features for matching, trained but not better than census in the same pipeline:
docs/matching.md.
"""
