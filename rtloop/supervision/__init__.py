"""Supervision of one run: start loop and recorder, watch them, park the outputs, report the result.

`rtloop run` and the daemon share this room. It may import configuration, recording and everything below. Begin with
`supervisor.py`.
"""
