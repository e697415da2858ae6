"""What is sought, and what a renderer draws; knows no method and no log."""
