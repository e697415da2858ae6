"""Steps inside a ball, a box and a Krylov space."""
