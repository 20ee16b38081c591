"""Changes to a law that runs: built and judged beside it, swapped at a tick, taken back."""
