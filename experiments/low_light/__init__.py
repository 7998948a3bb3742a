"""How the denoisers that ship for low light were trained."""
