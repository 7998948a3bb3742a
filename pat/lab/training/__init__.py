"""Training: recipes, samples, losses, the loop, checkpoints."""
