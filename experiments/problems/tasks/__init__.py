"""One file per task: its black box, parameters with ranges and units, starts, errors, and what its scene needs."""
