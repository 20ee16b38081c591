"""Export as CSV: the shortest decimals that `float()` reads back as the recorded numbers, formatted on all cores."""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import IO

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.foundation.processors import usable_processors

COUNTS = frozenset({"tick", "deadline_ns", "periods_missed", "flags", "mode", "driver_status"})
"""Signals that are whole numbers."""
LARGEST_COUNT = 2.0**53
ROWS_PER_TEXT = 1 << 14

FormatRows = Callable[[Sequence[str], Real], bytes]


def write_csv(file: IO[bytes], names: Sequence[str], blocks: Iterable[Real], progress: Callable[[int], None]) -> int:
    """Write a line of names, then a line for each row of `blocks` (n, names). Returns the number of rows.

    Whole numbers in signals of COUNTS have no decimal point. `progress` receives the number of rows written. pyarrow
    formats the rows, in a thread for each processor; without pyarrow, Python does, in one thread.
    """
    file.write((",".join(names) + "\n").encode("ascii"))
    row_count = 0
    for text, rows in _format_in_order(names, blocks, *_formatter()):
        file.write(text)
        row_count += len(rows)
        progress(row_count)
    return row_count


def _formatter() -> tuple[FormatRows, int]:
    """Return the fastest function that formats rows, and the number of threads that it can use."""
    try:
        import pyarrow.csv  # noqa: F401
    except ImportError:
        return _format_in_python, 1
    return _format_in_pyarrow, usable_processors()


def _format_in_order(
    names: Sequence[str], blocks: Iterable[Real], format_rows: FormatRows, threads: int
) -> Iterator[tuple[bytes, Real]]:
    """Split each block into parts; yield (lines of CSV, rows) of each part, in the order of the rows.

    `names` are the columns.

    At most two parts for each thread are held: being formatted, queued, or finished but not yielded.
    """
    pending: deque[tuple[Future[bytes], Real]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        for block in blocks:
            for begin in range(0, len(block), ROWS_PER_TEXT):
                rows = block[begin : begin + ROWS_PER_TEXT]
                pending.append((pool.submit(format_rows, names, rows), rows))
                if len(pending) > 2 * threads:
                    future, formatted_rows = pending.popleft()
                    yield future.result(), formatted_rows
        for future, formatted_rows in pending:
            yield future.result(), formatted_rows


def _format_in_pyarrow(names: Sequence[str], rows: Real) -> bytes:
    """Return rows (n, names) as lines of CSV without a header, formatted by pyarrow."""
    import pyarrow
    import pyarrow.csv

    columns = [_printed_values(name, rows[:, index]) for index, name in enumerate(names)]
    text = io.BytesIO()
    options = pyarrow.csv.WriteOptions(include_header=False, batch_size=len(rows))
    pyarrow.csv.write_csv(pyarrow.table(columns, list(names)), text, options)
    return text.getvalue()


def _format_in_python(names: Sequence[str], rows: Real) -> bytes:
    """Return rows (n, names) as lines of CSV without a header, formatted by Python."""
    fields = [map(repr, _printed_values(name, rows[:, index]).tolist()) for index, name in enumerate(names)]
    return "".join(",".join(row) + "\n" for row in zip(*fields, strict=True)).encode("ascii")


def _printed_values(name: str, values: Real) -> Real | npt.NDArray[np.int64]:
    """Return a signal's values (n,) in the type in which they are printed.

    int64 for a signal of COUNTS if every value has the same bytes after a conversion to int64 and back; else float64.
    """
    if name in COUNTS and bool(np.all(np.abs(values) < LARGEST_COUNT)):
        counts = values.astype(np.int64)
        if counts.astype(np.float64).tobytes() == values.tobytes():  # −0.0 is no whole number here
            return counts
    return np.ascontiguousarray(values)
