"""The daemon `rtloop serve`: one loop after another, the control API, live changes, measurements, CAN supervision.

It may import supervision and everything below. Begin with `service.py`, then `api/requests.py`.
"""
