"""Recordings: MCAP files (https://mcap.dev/spec) of runs, written beside the loop and read back exactly.

It may import the engine, the laws, the kernel and the drivers, but neither analysis nor configuration. Begin with
`load`; `file.writer` and `capture.recorder` write recordings, `file.reader` reads and verifies them.
"""
