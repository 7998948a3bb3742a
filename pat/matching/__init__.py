"""Positions of alpha's pixels in each beta, and the bands of the betas there."""
