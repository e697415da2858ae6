"""One run: counted, timed, journalled and replayed; knows no method by name."""
