"""Cut a range of ticks out of a recording, and find its ticks in the files."""
