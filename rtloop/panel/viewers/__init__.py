"""Viewers of others, which look at a running loop by the Foxglove WebSocket protocol."""
