"""Ticks of a running loop, read from its shared block without write access; no tick waits for a reader."""
