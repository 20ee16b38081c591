"""What a person at the bench looks at: a running loop's scope and spectrum, computed beside it.

    shared block ──► Reader ──► Stretch ──┬──► Trigger ──► Sweep ──┐
                                          ├──► History ────────────┴──► envelope
                                          └──► Spectrum ──► Density

`Reader` is one more reader of the ring of ticks and can write nothing there. A stretch goes to the history before its
sweeps are taken from it. Where `Stretch.run` changes, the loop was started anew and counts its ticks from 0: `close`
the triggers and take what they had open from the history before either is handed the new run.

`views` makes of these what each client wishes to see, `web` serves it to browsers, `page` is what they load.
"""
