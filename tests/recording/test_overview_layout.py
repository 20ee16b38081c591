"""An overview message of wrong length, or with a damaged field number, is refused before it is read as numbers."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.recording.file.topics.overview import OverviewLayout

LAYOUT = OverviewLayout(["tick", "deadline_ns", "x_drive_v"])


def payload_of(layout: OverviewLayout) -> bytes:
    """Return the content of one message with zeros in each figure."""
    (message,) = layout.make_messages(np.zeros((1, 3, 3)), 0)
    return message.payload


def test_a_whole_payload_is_accepted():
    LAYOUT.require_overview(payload_of(LAYOUT))


@pytest.mark.parametrize("change", [lambda payload: payload + b"\0", lambda payload: payload[:-1], lambda _: b""])
def test_a_payload_of_another_length_is_refused(change):
    with pytest.raises(ValueError, match="is damaged: it has a wrong length"):
        LAYOUT.require_overview(change(payload_of(LAYOUT)))


def test_a_payload_with_a_damaged_field_number_is_refused():
    payload = payload_of(LAYOUT)
    with pytest.raises(ValueError, match="its fields are not those of the recording"):
        LAYOUT.require_overview(bytes([payload[0] ^ 8]) + payload[1:])
