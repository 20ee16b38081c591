"""Reader of the loop for all clients of the panel, and its history: ticks, their extremes, lateness."""
