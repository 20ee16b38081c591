"""An overview message has the fields of its schema; one of wrong length, or with a damaged field number, is refused."""

from __future__ import annotations

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message_factory import GetMessages

from rtloop.recording.file.topics.overview import OverviewLayout, overview_records

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


@pytest.mark.parametrize("count", [5, 6, 682, 683, 2000])
def test_the_fields_are_those_of_the_schema_for_any_number_of_columns(count):
    """Google's decoder is the oracle. From 6 columns on a tag may take two bytes, from 683 on three."""
    columns = ["tick", "deadline_ns", *(f"signal{number}" for number in range(2, count))]
    intervals = np.arange(3.0 * count).reshape(1, count, 3)
    layout = OverviewLayout(columns)
    (message,) = layout.make_messages(intervals, 0)
    schema, _ = overview_records(columns)
    decoded = GetMessages(FileDescriptorSet.FromString(schema.data).file)["rtloop.Overview"].FromString(message.payload)
    names = [f"{column}_{figure}" for column in columns for figure in ("min", "max", "mean")]
    assert [getattr(decoded, name) for name in names] == list(range(3 * count))
    layout.require_overview(message.payload)
    assert np.array_equal(layout.parse_intervals([message.payload]), intervals)
