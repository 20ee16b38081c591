"""A recording executed again, and compared in bytes."""
