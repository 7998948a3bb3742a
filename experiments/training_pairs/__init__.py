"""Pairs that the choice between disparities is trained on."""
