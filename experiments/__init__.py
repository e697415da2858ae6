"""Tasks, baselines and plots: everything that produces the numbers and figures of the README."""
