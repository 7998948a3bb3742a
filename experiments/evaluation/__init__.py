"""The documentation's tables: the paper's protocols, conditions, certainty, calibration sweeps, fields."""
