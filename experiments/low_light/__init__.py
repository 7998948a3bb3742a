"""Training of the denoisers that ship for low light."""
