"""Linear systems of one input and one output: as they are written, as state spaces, held and sampled."""
