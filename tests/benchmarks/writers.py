"""Cost of writing ticks to a file, in comparison with the fastest known writers of MCAP and HDF5."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as StockWriter

from rtloop.recording.file.mcap.chunkfile import LEVEL
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.writer import Writer
from tests.benchmarks.kernels import ResultsDiffer
from tests.benchmarks.measure import Effort, MeasurementUnavailable, interleave, ratio, spread
from tests.benchmarks.scenario import PythonLoop, paper_plan

TICKS = 200_000
SLICE = 25_000
START_UNIX_NS = 1_700_000_000_000_000_000
SCHEMA = "rtloop.Tick"


class Stream:
    """Ticks of a closed loop as rows, and the same ticks as encoded messages with their times."""

    def __init__(self, ticks: int) -> None:
        plan = paper_plan()
        self.columns, loop = list(plan.columns), PythonLoop(plan)
        self.rows = np.empty((ticks, len(self.columns)))
        for begin in range(0, ticks, SLICE):
            loop.run(begin + SLICE)
            slots = np.arange(begin, begin + SLICE) % loop.rows.shape[0]
            self.rows[begin : begin + SLICE] = loop.rows[slots]
        _add_random_times(self.rows)
        self.chunk = format.chunk_rows(self.columns)
        self.blocks = [self.rows[begin : begin + self.chunk] for begin in range(0, ticks, self.chunk)]
        records = format.blank_ticks(self.columns, ticks)
        format.fill_ticks(records, self.columns, self.rows, START_UNIX_NS)
        data, size = records.tobytes(), records.dtype.itemsize
        head = records.dtype.fields["_publish_time"][1] + 8  # type: ignore[index]
        self.messages = [data[begin + head : begin + size] for begin in range(0, len(data), size)]
        self.times = records["_log_time"].tolist()
        self.schema = format.tick_schema(self.columns)


def _add_random_times(rows: np.ndarray[Any, Any]) -> None:
    """Replace the NaN of virtual time by random times in whole ns, which compress as badly as measured times."""
    random = np.random.default_rng(1)
    for column, typical_ns in ((2, 15_000), (3, 350), (4, 230), (5, 140), (6, 850)):
        rows[:, column] = np.rint(random.gamma(20.0, typical_ns / 20.0, len(rows))) * 1e-3


def rtloop(stream: Stream, path: Path) -> None:
    """Write by the recorder's writer, with its default index of messages."""
    writer = Writer(path, {"columns": stream.columns}, START_UNIX_NS, message_index=True)
    for block in stream.blocks:
        writer.write_ticks(block)
    writer.finish(lambda ticks: Message(format.EVENTS, stream.times[-1], b"{}"))


def foxglove(stream: Stream, path: Path) -> None:
    """Write by foxglove-sdk (Rust), message by message, compressed in the same thread."""
    import foxglove as sdk
    from foxglove.mcap import MCAPCompression, MCAPWriteOptions

    options = MCAPWriteOptions(
        compression=MCAPCompression.Zstd,
        compression_level=LEVEL,
        compression_threads=0,
        chunk_size=format.MAX_CHUNK_BYTES,
    )
    context = sdk.Context()
    writer = sdk.open_mcap(path, context=context, writer_options=options)
    schema = sdk.Schema(name=SCHEMA, encoding="protobuf", data=stream.schema)
    channel = sdk.Channel("/ticks", message_encoding="protobuf", schema=schema, context=context)
    for message, log_time in zip(stream.messages, stream.times, strict=True):
        channel.log(message, log_time=log_time)
    writer.close()


def mcap(stream: Stream, path: Path) -> None:
    """Write by the package mcap in Python, message by message."""
    with path.open("wb") as file:
        writer = StockWriter(file, chunk_size=format.MAX_CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema(SCHEMA, "protobuf", stream.schema)
        channel = writer.register_channel("/ticks", "protobuf", schema)
        for message, log_time in zip(stream.messages, stream.times, strict=True):
            writer.add_message(channel, log_time, message, log_time)
        writer.finish()


def h5py_plain(stream: Stream, path: Path) -> None:
    """Write HDF5 without compression, in chunks of rows."""
    _h5py(stream, path, chunks=(stream.chunk, len(stream.columns)))


def h5py_lzf(stream: Stream, path: Path) -> None:
    """Write HDF5 in chunks of one column, with shuffled bytes and LZF: the fastest setting with a similar size."""
    _h5py(stream, path, chunks=(stream.chunk, 1), compression="lzf", shuffle=True)


def _h5py(stream: Stream, path: Path, **options: Any) -> None:
    """Write the rows to an HDF5 dataset, block by block, with the options of `create_dataset`."""
    import h5py

    columns = len(stream.columns)
    with h5py.File(path, "w") as file:
        ticks = file.create_dataset("ticks", (0, columns), "f8", maxshape=(None, columns), **options)
        for block in stream.blocks:
            begin = len(ticks)
            ticks.resize(begin + len(block), axis=0)
            ticks[begin:] = block


WRITERS = {
    "rtloop": rtloop, "foxglove": foxglove, "mcap": mcap, "h5py_plain": h5py_plain, "h5py_lzf": h5py_lzf
}  # fmt: skip


def writers(effort: Effort) -> dict[str, Any]:
    """CPU time of all threads of the process to write the same ticks from memory to a file, open to close: µs a
    tick, which at 10 kHz is % of a processor. Also bytes a tick. The ticks come from a closed loop. Their
    measured times are drawn at random, because such times compress badly and virtual time has none. Ratios:
    rtloop over the other writer.

    - `rtloop`: the recorder's writer. It encodes rows.
    - `foxglove` (foxglove-sdk, in Rust) and `mcap` (the stock Python writer): the same protobuf messages with
      zstd and chunks of 1 MiB. Their messages are encoded before, which favours them.
    - `h5py`: the same rows in blocks, without compression, and with LZF over shuffled columns, which gives a
      similar size. HDF5 without compression takes more than twice the bytes and has no target.
    """
    try:
        import foxglove  # noqa: F401
        import h5py  # noqa: F401
    except ImportError as error:
        raise MeasurementUnavailable(f"{error.name} is not installed; the extra `bench` has it") from None
    stream = Stream(TICKS)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ticks"
        actions = {name: lambda write=write: _time_writer(write, stream, path) for name, write in WRITERS.items()}
        for name, action in actions.items():  # The first call imports, compiles and fills caches.
            action()
            _require_complete(name, stream, path)
        runs = interleave(actions, effort.pairs)
    figures: dict[str, Any] = {}
    cpu_us = {name: [1e6 * cpu_s / TICKS for cpu_s, _ in results] for name, results in runs.items()}
    for name, results in runs.items():
        figures[name] = {"cpu_us_per_tick": spread(cpu_us[name]), "bytes_per_tick": results[0][1] / TICKS}
        if name != "rtloop":
            figures[name]["cpu_ratio"] = ratio(cpu_us["rtloop"], cpu_us[name])
    return figures


def _require_complete(name: str, stream: Stream, path: Path) -> None:
    """Require that the format's library reads every tick from the file. Raises ResultsDiffer."""
    if name.startswith("h5py"):
        import h5py

        with h5py.File(path) as file:
            is_complete = np.array_equal(file["ticks"][()], stream.rows)  # type: ignore[index]
    else:
        with path.open("rb") as file:
            messages = [message.data for _, _, message in make_reader(file).iter_messages(topics=["/ticks"])]
        is_complete = messages == stream.messages
    if not is_complete:
        raise ResultsDiffer(f"writers: the file of {name} does not contain the ticks")


def _time_writer(write: Callable[[Stream, Path], None], stream: Stream, path: Path) -> tuple[float, int]:
    """Write the stream; return the processor time in s and the size of the file in bytes."""
    path.unlink(missing_ok=True)
    begin_s = time.process_time()
    write(stream, path)
    cpu_s = time.process_time() - begin_s
    return cpu_s, path.stat().st_size
