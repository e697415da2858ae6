"""Many runs: planned, spread over processes, and their provenance noted."""
