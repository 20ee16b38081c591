"""A stretch of a recording as one of its own, and where its ticks are found."""
