"""The panel: a running loop in the browser, in a process beside the loop.

    shared block ──► Reader ──► Stretch ──┬──► Trigger ──► Sweep ──┐
                                          ├──► TickHistory ────────┴──► envelope
                                          └──► Spectrum ──► Density

`web` serves pages and `foxglove` viewers; `views` makes the frames of each client from the ticks of `feed`; `page` is
what browsers load. The panel may import `rtloop.client` and all below it. Begin with `web/application` or `feed/feed`.

A stretch enters the history before its sweeps are drawn from it. When `Stretch.run` changes, the loop was started
again and counts its ticks from 0: `end_run` closes the triggers and draws their open sweeps before the new run begins.
"""
