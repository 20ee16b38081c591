"""Text of a file: unpacked, decoded, and cut into lines and records by one definition for all who read it.

A line ends with LF, CR LF or CR, and with no other character. A record is a line, or several where quotes hold them
together.
"""

from __future__ import annotations

import csv
import gzip
import io
import os
import re
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO, NamedTuple

from rtloop.foundation.trusted import open_user_file
from rtloop.interchange.formats.groups import MAX_BYTES
from rtloop.interchange.formats.table import UnreadableData

SAMPLE_BYTES = 1 << 16
LONGEST_LINE = 1 << 20
LONGEST_RECORD = 10
"""Lines that quotes may hold together; beyond it, the quote counts as a letter."""
GZIP_MAGIC = b"\x1f\x8b"
_MARKS = ((b"\xef\xbb\xbf", "utf-8"), (b"\xff\xfe", "utf-16-le"), (b"\xfe\xff", "utf-16-be"))
_LINE = re.compile(r"[^\r\n]*(?:\r\n|\r|\n)|[^\r\n]+")
_LINES_AT_ONCE = 4096


class Record(NamedTuple):
    """Fields of a record, without the blanks around them; `line`, from 1, is its first line, `lines` their number."""

    line: int
    lines: int
    fields: list[str]
    text: str


class TextSource:
    """An open text file. `head` are its first lines, `later` some from the middle and the end, all with their ends."""

    def __init__(self, path: Path) -> None:
        """Open the file, unpack it, and find its encoding.

        Raises UnreadableData if it is empty or no text, or its first line is longer than SAMPLE_BYTES.
        """
        self.path, self._file = path, _open(path)
        try:
            self._examine()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _examine(self) -> None:
        path = self.path
        self.size = self._file.seek(0, os.SEEK_END)
        first = self._read(0)
        mark, self.encoding = next(((m, name) for m, name in _MARKS if first.startswith(m)), (b"", _encoding(first)))
        self._begin = len(mark)
        places = [place // 4 * 4 for place in (self.size // 2, self.size - SAMPLE_BYTES) if place > SAMPLE_BYTES]
        texts = [self._decode(first[len(mark) :]), *(self._decode(self._read(place)) for place in places)]
        if any("\0" in text for text in texts):
            raise UnreadableData(
                f"{path}: neither text nor another known kind of file: MAT, HDF5, NetCDF, npz, Parquet, MCAP, TDMS, "
                "MF4 or Stabilizer's stream"
            )
        is_complete = self.size <= SAMPLE_BYTES
        self.head = split_lines(texts[0])[: None if is_complete else -1]
        if not self.head:
            fault = f"the first line is longer than {SAMPLE_BYTES} bytes" if self.size else "empty"
            raise UnreadableData(f"{path}: {fault}; allowed: a text file with lines of numbers")
        self.later = [line for text in texts[1:] for line in split_lines(text)[1:-1]]
        tail = texts[-1] if is_complete or not places else self._decode(self._read(places[-1]))
        self.tail = split_lines(tail)[0 if is_complete else 1 :]

    def _read(self, place: int) -> bytes:
        self._file.seek(place)
        return self._file.read(SAMPLE_BYTES)

    def _decode(self, block: bytes) -> str:
        return block.decode(self.encoding, "replace")

    def lines(self, first: int, footer: Sequence[str] = (), skip: Sequence[int] = ()) -> LineStream:
        """Return the text from the line `first`, from 0, on; without the last lines `footer` and the lines `skip`."""
        end = self.size - len("".join(footer).encode(self.encoding))
        self._file.seek(self._begin)
        text = io.TextIOWrapper(
            io.BufferedReader(_Window(self._file, end)), encoding=self.encoding, errors="replace", newline=""
        )
        return LineStream(self.path, text, first, frozenset(number for number in skip if number > first))


class _Window(io.RawIOBase):
    """The bytes of a file from its position to `end`."""

    def __init__(self, file: IO[bytes], end: int) -> None:
        self._file, self._left = file, end - file.tell()

    def readable(self) -> bool:
        """Return True, as io requires."""
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """Fill a buffer, up to the end; return the number of bytes."""
        data = self._file.read(min(len(buffer), self._left))
        buffer[: len(data)] = data
        self._left -= len(data)
        return len(data)


class LineStream(io.TextIOBase):
    """Lines for pandas; `read` raises UnreadableData for bytes that are no text and for a line beyond LONGEST_LINE."""

    def __init__(self, path: Path, text: io.TextIOWrapper, first: int, skip: frozenset[int]) -> None:
        """Skip the lines before `first`, from 0; the lines `skip`, from 1, are left out later."""
        self.first, self.join = first, None
        self._path, self._length, self._rest = path, 0, ""
        self._text, self._skip = text, skip
        self._numbered = enumerate(self._split(), start=1)
        for _ in range(first):
            next(self._numbered, None)

    join: Callable[[str], str] | None
    """A change of each line, before anybody reads it."""

    def _split(self) -> Iterator[str]:
        while block := self._text.read(SAMPLE_BYTES * 4):
            lines = split_lines(self._rest + self._checked(block))
            # A CR may be the first half of a line's end, and the last line may go on.
            self._rest = lines.pop()
            yield from lines
        if self._rest:
            yield self._rest

    def _checked(self, block: str) -> str:
        self._length = self._length + len(block) if "\n" not in block and "\r" not in block else 0
        if "\0" in block or self._length > LONGEST_LINE:
            fault = (
                "zero bytes, which are not text" if "\0" in block else f"a line longer than {LONGEST_LINE >> 20} MiB"
            )
            raise UnreadableData(f"{self._path}: damaged: contains {fault}")
        return block

    def numbered(self) -> Iterator[tuple[int, str]]:
        """Yield the number, from 1, and the text of each line."""
        for number, line in self._numbered:
            if number not in self._skip:
                yield number, self.join(line) if self.join else line

    def readable(self) -> bool:
        """Return True, as pandas requires."""
        return True

    def read(self, size: int | None = -1) -> str:
        """Return the next lines; "" at the end."""
        return "".join(line for _, (_, line) in zip(range(_LINES_AT_ONCE), self.numbered(), strict=False))

    def close(self) -> None:
        """Close the stream, but not its file."""
        self._text.close()
        super().close()

    def __iter__(self) -> Iterator[str]:
        """Return an iterator over the lines."""
        return (line for _, line in self.numbered())


def split_lines(text: str) -> list[str]:
    """Return the lines of a text, with their ends."""
    return _LINE.findall(text)


def logical_lines(lines: Sequence[str]) -> list[str]:
    """Return the lines, those that quotes hold together as one, with a blank for each break."""
    joined, position = list[str](), 0
    while position < len(lines):
        count, quotes = 1, lines[position].count('"')
        while quotes % 2 and count <= LONGEST_RECORD and position + count < len(lines):
            quotes += lines[position + count].count('"')
            count += 1
        count = count if quotes % 2 == 0 else 1
        *begin, end = lines[position : position + count]
        joined.append("".join(line.rstrip("\r\n") + " " for line in begin) + end)
        position += count
    return joined


def split_fields(line: str, delimiter: str | None) -> list[str]:
    """Return the fields of a record's text, without blanks and quotes around them; [] if it cannot be split.

    A `delimiter` of None is any number of blanks.
    """
    line = line.strip("\r\n")
    if delimiter is None and '"' not in line:
        return line.split()
    text = line if delimiter is not None else re.sub(r"\s+(?=(?:[^\"]*\"[^\"]*\")*[^\"]*$)", " ", line.strip())
    try:
        rows = csv.reader([text], delimiter=delimiter or " ", skipinitialspace=True)
        return [
            " ".join(field.split()) if "\n" in field or "\r" in field else field.strip() for field in next(rows, [])
        ]
    except csv.Error:
        return []


def split_records(lines: Sequence[str], delimiter: str | None) -> Iterator[Record]:
    """Yield the records of lines; a quote that stays open beyond LONGEST_RECORD lines holds none together."""
    position = 0
    while position < len(lines):
        count = _record_length(lines, position, delimiter)
        text = "".join(lines[position : position + count])
        joined = re.sub(r"[\r\n]+", " ", text.rstrip("\r\n"))
        yield Record(position + 1, count, split_fields(joined, delimiter), joined)
        position += count


def _record_length(lines: Sequence[str], position: int, delimiter: str | None) -> int:
    """Return the number of lines of the record that begins at a line; 1 if its quotes are never closed."""
    if lines[position].count('"') % 2 == 0:
        return 1
    reader = csv.reader(iter(lines[position : position + LONGEST_RECORD + 1]), delimiter=delimiter or " ")
    try:
        next(reader)
    except csv.Error:
        return 1
    quotes = "".join(lines[position : position + reader.line_num]).count('"')
    return reader.line_num if reader.line_num <= LONGEST_RECORD and quotes % 2 == 0 else 1


def _open(path: Path) -> IO[bytes]:
    """Return the file, unpacked if it is packed by gzip. Raises UnreadableData if it is damaged or too large."""
    file = os.fdopen(open_user_file(path), "rb")
    if file.read(len(GZIP_MAGIC)) != GZIP_MAGIC:
        return file
    file.seek(0)
    try:
        with file, gzip.GzipFile(fileobj=file) as packed:
            content = packed.read(MAX_BYTES + 1)
    except (OSError, EOFError, zlib.error) as fault:
        raise UnreadableData(f"{path}: damaged: {fault}; pack or copy the file again") from None
    if len(content) > MAX_BYTES:
        raise UnreadableData(f"{path}: unpacked, more than {MAX_BYTES >> 30} GiB; unpack the file with gunzip")
    return io.BytesIO(content)


def _encoding(block: bytes) -> str:
    """Return the encoding of text without a byte order mark: by its zero bytes UTF-16, else "utf-8" or "cp1252"."""
    for odd, name in ((1, "utf-16-le"), (0, "utf-16-be")):
        if len(block) > 1 and block[odd::2].count(0) > len(block) // 4 and block[1 - odd :: 2].count(0) == 0:
            return name
    try:
        block[: -4 if len(block) == SAMPLE_BYTES else None].decode()
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"
