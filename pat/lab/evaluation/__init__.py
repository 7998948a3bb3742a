"""Scores, baselines and ablations of fusions: the paper's protocols, tables and figures."""
