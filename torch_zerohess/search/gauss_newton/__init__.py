"""Gauss-Newton for an output: its Jacobian by interpolation or by samples, and steps at kinks of the loss."""
