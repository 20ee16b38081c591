"""Recordings of the service for pages: the folder, sweeps from a file, and work in processes beside the panel."""
