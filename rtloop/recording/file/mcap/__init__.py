"""The MCAP container: write, find and read chunks, whatever they contain."""
