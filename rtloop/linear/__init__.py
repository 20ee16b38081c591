"""Linear systems of one input and one output: transfer functions, state spaces, hold and sampling."""
