"""Ask and tell, whatever the search: its state, bounds and random points, and the values that it is told."""
