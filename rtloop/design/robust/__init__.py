"""A controller that damps resonances wherever they may lie, and the reference's taps that go with it."""
