"""Training of fusion networks: recipes, samples, losses, the loop, checkpoints."""
