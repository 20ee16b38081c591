"""EPICS channels of a running loop, served over Channel Access by a process beside the service: `rtloop epics`.

The room uses the public client alone. Begin with `channels`, the table of all channels; `requests` sends what clients
write to the service, `server` updates the channels and serves them. All but `variables` needs caproto.
"""
