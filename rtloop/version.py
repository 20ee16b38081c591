"""The version of rtloop, for rooms that name it in their output."""

__version__ = "0.2.0"
