"""The recorder process: copies the ticks, events and snapshots of the loop's rings into files."""
