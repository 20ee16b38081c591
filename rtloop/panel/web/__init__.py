"""The panel's server: pages, the control API handed on, and what `rtloop.panel.views` shows, for browsers on this host.

browser ──HTTP──► Guard ──► Proxy ──► control socket of the service
        ◄─/live──   └─────► Live ◄── Viewer ◄── Feed ◄── shared block (read-only)
"""
