"""From the rings to a file, in a process of its own."""
