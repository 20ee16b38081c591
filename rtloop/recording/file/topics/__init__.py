"""Contents of a recording: header, ticks, events and overviews, their layout and their validation."""
