"""A controller that damps resonances over a range of frequencies, and the reference taps that fit it."""
