"""Measurements on a running loop: response, gain, learning of a scan, scheduled retuning, sums of its quality."""
