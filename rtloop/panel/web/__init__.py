"""The panel's server: pages, the control API handed on, and the running loop as it is seen, for browsers on this host.

    browser ──HTTP──► Guard ──► proxy ────────────────► control socket of the service
            ◄─/live──   └─────► live ◄── Viewer ◄── Feed ◄── shared block (read-only)

One thread, the `Feed`, reads for everybody. A viewer is what one client wants to see; it is asked for frames when that
client can take them, so that nothing waits anywhere for somebody who does not read.
"""
