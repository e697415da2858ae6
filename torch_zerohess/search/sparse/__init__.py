"""`LocalGaussNewton`: Gauss-Newton on a sparse Jacobian, with and without noise."""
