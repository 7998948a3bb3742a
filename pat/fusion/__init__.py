"""The fusion of frames, batches and sequences."""
