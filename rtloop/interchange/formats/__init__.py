"""Readers of other programs' files, a module for each format; each returns a table."""
