"""rtloop: a hard, fast control loop from Python, with a recording that proves what it did."""

__version__ = "0.1.0"
