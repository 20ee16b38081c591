"""Replay: execute a recording again and compare the outputs in bytes."""
