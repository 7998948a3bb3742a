"""The researcher's room: synthesis, data, training, evaluation, the farm and their commands."""
