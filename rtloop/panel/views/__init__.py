"""Views of one client: scope, spectrum, drive against position, and the frames that are due.

    shared block ──► Feed ──┬──► TickHistory, Timing, Events      for all clients
                            └──► Viewer ──► Scope, Analyser, XyPlot ──► frames

The thread of the `Feed` reads for all clients. A viewer makes frames when its client can take them, so that no work
waits for a client that does not read.
"""
