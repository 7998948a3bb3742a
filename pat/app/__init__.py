"""Application: commands, explorer, pages, batches, and fusion without a rig."""
