"""Recordings: one MCAP file per run, written beside the loop and read back exactly.

Format: https://mcap.dev/spec. `writer` and `recorder` write, `reader` reads and verifies, the rest builds on these.
"""
