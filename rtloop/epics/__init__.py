"""EPICS channels of a running loop, served over Channel Access by a process beside the service: `rtloop epics`.

The room uses the public client alone. Begin with `variables`, the table of all channels; `channels` makes them,
`requests` sends the writes of clients to the service, `server` updates the channels and serves them. `channels` and
`server` need caproto.
"""
