"""The control API: what is asked over the socket, by whom, how many at a time, and what is answered."""
