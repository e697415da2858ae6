"""Tables, figures and pages of results; runs nothing that counts."""
