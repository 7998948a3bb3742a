"""Differentiable geometry of rigs of N unlike cameras."""
