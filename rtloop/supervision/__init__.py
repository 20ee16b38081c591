"""Who keeps a loop and its recorder: starts, watches, parks, and says how it went; for a run and for the daemon."""
