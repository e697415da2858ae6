"""Steps inside a ball, a box, the region of a metric, or a Krylov space; Jacobians of many parameters; flat vectors."""
