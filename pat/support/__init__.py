"""Shared services without computer vision: jobs, memory, documents, threads."""
