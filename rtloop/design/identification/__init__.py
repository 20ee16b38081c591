"""Models of an actuator from its recordings: hysteresis, dynamics, delay, with their uncertainties."""
