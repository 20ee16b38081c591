"""All components by name, and the surroundings that they share."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

from rtloop.drivers.registry import BUILT_IN
from tests.syscalls import card
from tests.syscalls.component import Component
from tests.syscalls.files import Cutting, KeepingQuota, Recovering
from tests.syscalls.parking import Noting, ParkingABoard, ParkingACard, ParkingTheNoted
from tests.syscalls.recorder import Recording
from tests.syscalls.recordings import small_chunks
from tests.syscalls.service import ImportingAService, StartingAService, StoppingAService

IMPORTS = 20
"""Number of calls in a service's imports that are tried: each try takes seconds, and thousands of calls are alike."""
COMPONENTS = {
    component.name: component
    for component in (
        Component("recorder", Recording, share=24),
        Component("recover", Recovering, share=12),
        Component("cut", Cutting, share=12),
        Component("quota", KeepingQuota, share=12),
        Component("note", Noting, share=6),
        Component("parking", ParkingABoard, share=12),
        Component("parking-noted", ParkingTheNoted, share=6),
        Component("parking-card", ParkingACard, share=12),
        Component("service-imports", ImportingAService, share=0, max_calls=IMPORTS),
        Component("service-start", StartingAService, share=1, is_thinned=True),
        Component("service-stop", StoppingAService, share=1, is_thinned=True),
    )
}


@contextmanager
def surroundings() -> Iterator[None]:
    """Set small chunks and register the card in a file; restore environment variables and signal mask at the end."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    with small_chunks(), patch.dict(BUILT_IN, {card.KIND: "tests.syscalls.card:FileCard"}), patch.dict(os.environ):
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
