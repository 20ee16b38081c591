"""The panel's server for browsers on this host: pages, the forwarded control API, and the views of each client.

browser ──HTTP──► Guard ──► Proxy ──► control socket of the service
        ◄─/live──   └─────► Live ◄── Viewer ◄── Feed ◄── shared block (read-only)
"""
