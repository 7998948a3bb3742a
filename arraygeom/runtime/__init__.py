"""Support that is not geometry: threads, compiled kernels, atomic files, progress, warnings, messages."""
