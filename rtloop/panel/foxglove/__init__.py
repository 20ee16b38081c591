"""Read-only access for viewers of the Foxglove WebSocket protocol, such as Foxglove Studio."""
