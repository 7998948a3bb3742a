"""C3 attention: collect, correlate, combine."""
