"""Live changes of a running loop: laws are built and checked in another process, loaded at one tick, and undone."""
