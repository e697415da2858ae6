"""One batch of evaluations, and the estimates of a smoothed function from it."""
