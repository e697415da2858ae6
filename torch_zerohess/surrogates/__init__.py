"""Models fitted to evaluations; they never ask for points."""
