"""The application: commands, explorer, pages, batches, and fusing without a rig."""
