"""`GaussianProcessSearch`: a Gaussian process of a loss or an output, and the local search that finishes it."""
