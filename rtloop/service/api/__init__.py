"""The control API: table of requests, their bodies, requesters, lanes, answers, metrics. Begin with `requests.py`."""
