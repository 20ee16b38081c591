"""MCAP files that other tools wrote: gone through, their numbers, and rtloop's recordings among them."""
