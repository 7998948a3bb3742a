"""The training engine: recipes, samples, losses, the loop, and what it leaves on disk."""
