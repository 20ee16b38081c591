"""Recordings as files: writer, reader, validation, recovery, and conversion of files by other tools."""
