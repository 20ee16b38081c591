"""The MCAP container: chunks written, found and read. It knows nothing of ticks."""
