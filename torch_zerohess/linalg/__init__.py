"""Steps inside a ball, a box, a metric and a Krylov space; Jacobians of many parameters; tensors as one vector."""
