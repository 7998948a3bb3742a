"""Research tools: synthesis, data, training, evaluation, the rendering farm, and their commands."""
