"""Files as other programs write them, one module a format: what they hold, as a table."""
