"""The tables of the documentation: the paper's protocols, conditions, certainty, sweeps of calibration, every
field.
"""
