"""Where the chunks of a recording are, by who wrote the file: rtloop, whose layout is read as it stands, or another."""

from __future__ import annotations

from rtloop.recording.errors import RecordingError
from rtloop.recording.file.foreign.rewritten import NoRecording, Rewritten
from rtloop.recording.file.foreign.stretches import library
from rtloop.recording.file.mcap.chunks import Entry, Source, indexed_chunks, scanned_chunks
from rtloop.recording.file.mcap.container import MAGIC, DamagedChunk, unpack_chunk
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import read_chunk
from rtloop.recording.file.topics.header import own_header, read_header

OWN = (format.LIBRARY, "")
"""What the first record says of who wrote the file, if it says it."""


class Own:
    """The chunks of a file that rtloop wrote. Raises DamagedChunk where it is none, or its beginning is damaged.

    Raises RecordingError where its header is malformed.
    """

    ahead = 16
    """Chunks that are decompressed beyond the one that is asked for."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self.problems: list[str] = []
        self.left_out: list[str] = []
        self.entries = self._find_chunks()
        if not self.entries:
            raise DamagedChunk("it holds no chunk")
        content = self.content(self.entries[0])
        self.header = read_header(source.path, own_header(content), content)

    def content(self, entry: Entry) -> bytes:
        """What a chunk holds. Raises DamagedChunk."""
        return unpack_chunk(read_chunk(self._source, entry))

    @property
    def is_mixed(self) -> bool:
        """Whether the index knows of ticks that lie among other messages: that is not how rtloop lays them."""
        offsets = (entry.index.message_index_offsets for entry in self.entries if entry.index)
        return any(len(channels) > 1 and format.TICKS in channels for channels in offsets)

    def _find_chunks(self) -> list[Entry]:
        try:
            return indexed_chunks(self._source)
        except DamagedChunk as reason:
            entries, problems = scanned_chunks(self._source)
            self.problems += [f"{reason}: read from the beginning, without its index", *problems]
            self.left_out += problems
            return entries


def layout_of(source: Source) -> Own | Rewritten:
    """The chunks of a recording. Raises RecordingError where the file is another's, of a newer version, or damaged."""
    written_by = library(source)
    if written_by not in OWN:
        try:
            return Rewritten(source)
        except NoRecording as reason:
            try:  # it may be rtloop's own with a damaged name
                return Own(source)
            except DamagedChunk:
                raise reason from None
    try:
        own = Own(source)
    except DamagedChunk as damage:
        try:
            return Rewritten(source)
        except NoRecording:
            if format.PROFILE.encode() not in source.read(len(MAGIC), 64):
                raise
            raise RecordingError(f"{source.path}: the beginning of the recording is damaged ({damage})") from None
    return Rewritten(source) if own.is_mixed else own
