"""Models of an actuator from its recordings: hysteresis, dynamics, delay, and how far they are to be trusted."""
