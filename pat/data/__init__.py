"""Pairs and arrays on disk."""
