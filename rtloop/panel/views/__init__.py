"""What clients of a running loop wish to see of it, and get: one reader for all, a viewer for each.

    shared block ──► Feed ──┬──► Past, Timing, Events          for all
                            └──► Viewer ──► Scope, Analyser, Drawn ──► frames

One thread, the `Feed`, reads for everybody. A viewer is what one client wants to see; it is asked for frames when that
client can take them, so that nothing waits anywhere for somebody who does not read.
"""
