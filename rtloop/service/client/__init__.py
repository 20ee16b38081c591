"""Client of the control API for `rtloop ctl`, scripts and notebooks; it does not import numpy."""

from rtloop.service.client.client import Client as Client
