"""Find the chunks of a recording: in the file itself if rtloop wrote it, else in a converted copy."""

from __future__ import annotations

from rtloop.recording.errors import RecordingError
from rtloop.recording.file.conversion import open_converted_copy
from rtloop.recording.file.mcap.chunks import ChunkEntry, McapSource, read_chunk_index, scan_chunks
from rtloop.recording.file.mcap.container import MAGIC, DamagedChunk, unpack_chunk
from rtloop.recording.file.mcap.stock import library_name
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import may_hold, read_chunk, starts_with_tick
from rtloop.recording.file.topics.header import header_payload, read_header

OWN_LIBRARIES = (format.LIBRARY, "")
"""Library names of rtloop in the first record of a file; empty if the record is unreadable."""


class OwnLayout:
    """Chunks of a file that rtloop wrote, with its header; `left_out` are those of `problems` that removed data."""

    def __init__(self, source: McapSource) -> None:
        """Find the chunks of the file `source` and read the header of the recording.

        Raises DamagedChunk for a file by another tool or with a damaged beginning, RecordingError for a malformed
        header or a newer version.
        """
        self._source = source
        self.problems: list[str] = []
        self.left_out: list[str] = []
        self.entries = self._find_chunks()
        if not self.entries:
            raise DamagedChunk("the file holds no chunk")
        content = self.content(self.entries[0])
        self.header = read_header(source.path, header_payload(content), content)

    def content(self, entry: ChunkEntry) -> bytes:
        """Return the unpacked content of a chunk.

        Raises DamagedChunk if it is damaged or contradicts the index, RecordingError if the file cannot be read.
        """
        content = unpack_chunk(read_chunk(self._source, entry))
        if entry.index and starts_with_tick(content) != may_hold(entry, format.TICKS):
            raise DamagedChunk("ticks are where the index of the file names other messages, or the reverse")
        return content

    @property
    def is_mixed(self) -> bool:
        """Whether the index has a chunk of ticks and other messages, which rtloop does not write."""
        indexes = (entry.index for entry in self.entries if entry.index)
        return any(len(index.channels) > 1 and format.TICKS in index.channels for index in indexes)

    def _find_chunks(self) -> list[ChunkEntry]:
        """Return the chunks by the index of the file or, if that is missing or damaged, by a scan of the file.

        The missing index and the faults that the scan finds are added to `problems`, these faults also to `left_out`.
        """
        try:
            return read_chunk_index(self._source)
        except DamagedChunk as reason:
            entries, problems = scan_chunks(self._source)
            self.problems += [f"{reason}: the file is read from the beginning, without the index", *problems]
            self.left_out += problems
            return entries


def open_layout(source: McapSource) -> tuple[McapSource, OwnLayout]:
    """Find the chunks of a recording. Returns the file with the chunks, `source` or its converted copy, and its layout.

    `source` is closed if the copy is returned. Raises RecordingError for a file without a recording, a damaged one, and
    one of a newer version; `source` stays open then.
    """
    if library_name(source) not in OWN_LIBRARIES:
        try:
            return _open_converted(source)
        except RecordingError as reason:
            try:  # It may be rtloop's own file with a damaged library name.
                return source, OwnLayout(source)
            except DamagedChunk:
                raise reason from None
    try:
        layout = OwnLayout(source)
    except DamagedChunk as damage:
        try:
            return _open_converted(source)
        except RecordingError as reason:
            if format.PROFILE.encode() not in source.read(len(MAGIC), 64):
                raise
            raise RecordingError(
                f"{source.path}: the beginning of the recording is damaged ({damage}) and cannot be recovered; use "
                "another copy"
            ) from reason
    return _open_converted(source) if layout.is_mixed else (source, layout)


def _open_converted(source: McapSource) -> tuple[McapSource, OwnLayout]:
    """Return a converted copy of `source` and its layout, and close `source`.

    Raises RecordingError if the file cannot be converted or the copy is unreadable; `source` stays open then.
    """
    copy = open_converted_copy(source)
    try:
        layout = OwnLayout(copy)
    except DamagedChunk as damage:
        copy.close()
        raise RecordingError(f"{source.path}: cannot be converted ({damage}); use another copy") from damage
    except BaseException:
        copy.close()
        raise
    source.close()
    return copy, layout
