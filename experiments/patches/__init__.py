"""The paper's patches of rendered scenes as a data set of torch."""
