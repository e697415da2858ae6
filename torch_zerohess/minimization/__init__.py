"""A search whose points are evaluated for the user: record, noise, decision at the end, and its file."""
