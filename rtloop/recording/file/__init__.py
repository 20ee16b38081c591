"""The container: what is written, read, checked and repaired."""
