"""The service that the panel shows: its description of the loop, and its state twenty times a second."""
