"""One batch of evaluations, and what it says about a smoothed function."""
