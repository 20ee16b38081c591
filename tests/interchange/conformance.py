"""Files like the public MCAP conformance suite: six contents, each with any set of ten features.

The stock writer makes the files. Two kinds of messages are tried: bytes of an unknown encoding, as in the
public suite, and JSON with numbers, which can be imported.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterable, Iterator
from itertools import chain, combinations
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.writer import IndexType, Writer

CONTENTS = ("NoData", "OneAttachment", "OneMetadata", "OneMessage", "OneSchemalessMessage", "TenMessages")
CHUNKS, PADDING = "UseChunks", "AddExtraDataToRecords"
INDEXES = {
    "UseMessageIndex": IndexType.MESSAGE,
    "UseChunkIndex": IndexType.CHUNK,
    "UseAttachmentIndex": IndexType.ATTACHMENT,
    "UseMetadataIndex": IndexType.METADATA,
}
REPEATED = ("UseStatistics", "UseRepeatedSchemas", "UseRepeatedChannelInfos", "UseSummaryOffset")
FEATURES = (CHUNKS, *INDEXES, *REPEATED, PADDING)
MAGIC = b"\x89MCAP0\r\n"
EXTRA = b"\x01\x02\x03"
EXTENSIBLE = (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT, Opcode.DATA_END)
"""Records that may have more data behind their fields; the payload of a message or a chunk ends with its record."""
STEP_NS = 1_000_000


class Variant(NamedTuple):
    """A file of the suite. `numbers`: the messages are JSON with a number, else three bytes of the encoding "a"."""

    content: str
    features: frozenset[str]
    numbers: bool

    @property
    def messages(self) -> int:
        """Number of messages in the file."""
        return 10 if self.content == "TenMessages" else int(self.content.endswith("Message"))

    def __str__(self) -> str:
        return "-".join([self.content, *sorted(self.features), "json" if self.numbers else "bytes"])

    def data(self) -> bytes:
        """Return the bytes of the file."""
        stream = io.BytesIO()
        indexes = [index for name, index in INDEXES.items() if name in self.features]
        writer = Writer(
            stream,
            index_types=IndexType(sum(index.value for index in indexes)),
            use_chunking=CHUNKS in self.features,
            use_statistics="UseStatistics" in self.features,
            repeat_schemas="UseRepeatedSchemas" in self.features,
            repeat_channels="UseRepeatedChannelInfos" in self.features,
            use_summary_offsets="UseSummaryOffset" in self.features,
            enable_crcs=PADDING not in self.features,
        )
        writer.start()
        self._write(writer)
        writer.finish()
        return _padded(stream.getvalue()) if PADDING in self.features else stream.getvalue()

    def _write(self, writer: Writer) -> None:
        """Write the attachment, the metadata or the messages."""
        if self.content == "OneAttachment":
            writer.add_attachment(2, 1, "myFile", "application/octet-stream", EXTRA)
        if self.content == "OneMetadata":
            writer.add_metadata("myMetadata", {"foo": "bar"})
        if not self.messages:
            return
        encoding, kind = ("json", "jsonschema") if self.numbers else ("a", "c")
        schema = 0 if self.content == "OneSchemalessMessage" else writer.register_schema("Example", kind, b"{}")
        channel = writer.register_channel("example", encoding, schema, {"foo": "bar"})
        for number in range(self.messages):
            payload = b'{"value": %d}' % number if self.numbers else EXTRA
            writer.add_message(channel, number * STEP_NS, payload, number * STEP_NS, number)


def variants(max_features: int = len(FEATURES)) -> Iterator[Variant]:
    """Yield all variants with at most `max_features` features, or with all features but at most `max_features`."""
    small_sets: Iterable[tuple[str, ...]] = chain.from_iterable(
        combinations(FEATURES, n) for n in range(max_features + 1)
    )
    feature_sets = dict.fromkeys(
        chain.from_iterable((frozenset(names), frozenset(FEATURES) - set(names)) for names in small_sets)
    )
    for content in CONTENTS:
        for features in feature_sets:
            for numbers in (False, True) if content.endswith(("Message", "Messages")) else (False,):
                yield Variant(content, features, numbers)


def _padded(data: bytes) -> bytes:
    """Return the data section with EXTRA behind the fields of records; no summary, whose offsets would be wrong."""
    out, position = bytearray(MAGIC), len(MAGIC)
    while True:
        opcode, length = struct.unpack_from("<BQ", data, position)
        record = data[position + 9 : position + 9 + length]
        extra = EXTRA if opcode in EXTENSIBLE else b""
        out += struct.pack("<BQ", opcode, length + len(extra)) + record + extra
        position += 9 + length
        if opcode == Opcode.DATA_END:
            return bytes(out + struct.pack("<BQQQI", Opcode.FOOTER, 20, 0, 0, 0) + MAGIC)
