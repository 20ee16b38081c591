"""Where the chunks of a recording are: in the file itself where rtloop wrote it, else in a converted copy."""

from __future__ import annotations

from rtloop.recording.errors import RecordingError
from rtloop.recording.file.conversion import converted
from rtloop.recording.file.mcap.chunks import ChunkEntry, McapSource, read_chunk_index, scan_chunks
from rtloop.recording.file.mcap.container import MAGIC, DamagedChunk, unpack_chunk
from rtloop.recording.file.mcap.stock import library
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import read_chunk
from rtloop.recording.file.topics.header import own_header_payload, read_header

OWN_LIBRARIES = (format.LIBRARY, "")
"""What the first record says of who wrote the file, if it says it."""


class OwnLayout:
    """The chunks of a file that rtloop wrote. Raises DamagedChunk where it is none, or its beginning is damaged.

    Raises RecordingError where its header is malformed.
    """

    def __init__(self, source: McapSource) -> None:
        self._source = source
        self.problems: list[str] = []
        self.left_out: list[str] = []
        self.entries = self._find_chunks()
        if not self.entries:
            raise DamagedChunk("it holds no chunk")
        content = self.content(self.entries[0])
        self.header = read_header(source.path, own_header_payload(content), content)

    def content(self, entry: ChunkEntry) -> bytes:
        """What a chunk holds. Raises DamagedChunk."""
        return unpack_chunk(read_chunk(self._source, entry))

    @property
    def is_mixed(self) -> bool:
        """Whether the index knows of ticks that lie among other messages: that is not how rtloop lays them."""
        offsets = (entry.index.message_index_offsets for entry in self.entries if entry.index)
        return any(len(channels) > 1 and format.TICKS in channels for channels in offsets)

    def _find_chunks(self) -> list[ChunkEntry]:
        try:
            return read_chunk_index(self._source)
        except DamagedChunk as reason:
            entries, problems = scan_chunks(self._source)
            self.problems += [f"{reason}: read from the beginning, without its index", *problems]
            self.left_out += problems
            return entries


def open_layout(source: McapSource) -> tuple[McapSource, OwnLayout]:
    """The chunks of a recording, and the file that holds them: `source`, or its copy where another tool wrote it.

    Raises RecordingError where the file holds no recording, or is damaged or of a newer version.
    """
    if library(source) not in OWN_LIBRARIES:
        try:
            return _open_converted(source)
        except RecordingError as reason:
            try:  # it may be rtloop's own with a damaged name
                return source, OwnLayout(source)
            except DamagedChunk:
                raise reason from None
    try:
        own = OwnLayout(source)
    except DamagedChunk as damage:
        try:
            return _open_converted(source)
        except RecordingError as reason:
            if format.PROFILE.encode() not in source.read(len(MAGIC), 64):
                raise
            raise RecordingError(f"{source.path}: the beginning of the recording is damaged ({damage})") from reason
    return _open_converted(source) if own.is_mixed else (source, own)


def _open_converted(source: McapSource) -> tuple[McapSource, OwnLayout]:
    """Return a converted copy of `source` and its layout, and close `source`. Raises RecordingError, DamagedChunk."""
    copy = converted(source)
    try:
        own = OwnLayout(copy)
    except BaseException:
        copy.close()
        raise
    source.close()
    return copy, own
