"""What all tests share: no example fails because the machine was busy, and Ctrl-C reaches what they start.

Processes compute with one thread each, as the command line does.
"""

from __future__ import annotations

import os
import signal

from hypothesis import settings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before anything imports numpy

settings.register_profile("patient", deadline=None)
settings.load_profile("patient")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # what a shell starts in the background inherits that
    signal.signal(signal.SIGINT, signal.default_int_handler)
