"""`Descent`, and the models of a loss or an output that it follows downhill."""
