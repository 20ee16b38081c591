"""Captures of a running loop: trigger conditions, the trigger that finds sweeps, and ticks saved as a recording."""
