"""The control API: table of requests, their bodies, requesters, lanes, responses, metrics. Begin with `requests.py`."""
