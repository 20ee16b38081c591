"""From a specification to a controller: weights, H∞, reduction, and what is written of it."""
