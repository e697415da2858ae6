"""Ready-made black boxes around other programs; each module needs its own optional package and only when used."""
