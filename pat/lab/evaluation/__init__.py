"""Evaluation of fusions: the paper's protocols, baselines, ablations, tables and figures."""
