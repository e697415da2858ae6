"""One question, one file, one command."""
