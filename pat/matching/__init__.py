"""Where the pixels of alpha are in each beta, and what the betas show there."""
