"""What a recording holds: its header, ticks, events and overviews, as they are written and as they are believed."""
