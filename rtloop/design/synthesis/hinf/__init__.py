"""H∞ for any generalised plant: assumptions, normal form, two Riccati equations, the norm; SLICOT beside it."""
