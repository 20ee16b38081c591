"""Clients of a running service: `rtloop.connect`, the control socket, the ring of ticks, and captures of a run.

The command line, the panel and notebooks use this room. It may import `rtloop.service`, `rtloop.design` and all below
them. Begin with `connection`; `control` is the HTTP client that it stands on. Importing this room loads no numpy.
"""

from rtloop.client.control import Client as Client
