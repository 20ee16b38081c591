"""What talks to a service: `rtloop ctl`, scripts, notebooks. Nothing in here needs numpy."""

from rtloop.service.client.client import Client as Client
