"""Controller synthesis from a specification: weights, H∞, reduction, and the written sections."""
