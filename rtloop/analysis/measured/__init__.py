"""A loop as it is measured while it stays closed: excitation, response with its uncertainty, margins, a light mode."""
