"""Measurement of the time that the host kept processes waiting, by one witness process on each processor.

A bound on a time holds for a host that runs its processes. Stalls of the host are measured and added to the bound:

    stolen     a witness that asked to sleep for PERIOD_S woke later, and had not been waiting for its processor:
               the whole machine stood still. Spans of several processors that overlap count once.
    waited     the kernel's account (schedstat) of the time that a thread was ready and not run. Only threads on whose
               work the output depends are counted: the waits of others delay nothing

A thread that sleeps, or waits for a lock or a file, adds to neither.
"""

from __future__ import annotations

import mmap
import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

PERIOD_S, LEAST_S = 0.005, 0.0005
"""Sleep of a witness, and the shortest delay that it records, in s."""
SPANS, SPAN_BYTES = 1 << 14, 16
ACCOUNT_BYTES = 100
NS_PER_S, NS_PER_MS = 1e9, 1e6


def waited_ns(pid: int, every_thread: bool = False) -> dict[int, int]:
    """Return, by thread id, the ns that a process's first thread was ready and not run; empty if the process is gone.

    With `every_thread`, the result has all threads of the process and of its children.
    """
    tasks, waits_ns = {pid: Path(f"/proc/{pid}")}, dict[int, int]()
    if every_thread:
        for process in (pid, *_children(pid)):
            with suppress(OSError):
                tasks |= {int(task.name): task for task in Path(f"/proc/{process}/task").iterdir()}
    for number, task in tasks.items():
        with suppress(OSError):
            waits_ns[number] = _waited_ns((task / "schedstat").read_bytes())
    return waits_ns


def _children(pid: int) -> list[int]:
    """Return the ids of the processes that the threads of a process have started."""
    children = list[int]()
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            with suppress(OSError):
                children += map(int, (task / "children").read_text().split())
    return children


def _waited_ns(account: bytes) -> int:
    """Return the second number of a schedstat file: ns that the thread waited for a processor."""
    return int(account.split()[1])


def overlapping_ns(spans: list[tuple[int, int]], from_ns: int, to_ns: int) -> int:
    """Return the length in ns of the union of `spans` between two times."""
    total, reached = 0, from_ns
    for begin_ns, end_ns in sorted(spans):
        begin_ns, end_ns = max(begin_ns, reached), min(end_ns, to_ns)
        if end_ns > begin_ns:
            total, reached = total + end_ns - begin_ns, end_ns
    return total


class HostWitness:
    """Witness processes, one for each processor that this process may use."""

    def __init__(self, folder: Path) -> None:
        self._files, self._processes = [], []
        for cpu in sorted(os.sched_getaffinity(0)):
            path = folder / f"host-{cpu}"
            path.write_bytes(bytes(SPAN_BYTES * (SPANS + 1)))
            self._files.append(_numbers(path))
            self._processes.append(subprocess.Popen([sys.executable, "-S", __file__, str(path), str(cpu)]))

    def stolen_ms(self, from_ns: int, to_ns: int) -> float:
        """Return the ms that the whole host stood still between two times of CLOCK_MONOTONIC."""
        spans = [(file[2 * i], file[2 * i + 1]) for file in self._files for i in range(1, file[0] + 1)]
        return overlapping_ns(spans, from_ns, to_ns) / NS_PER_MS

    def end(self) -> None:
        """End the witness processes."""
        for process in self._processes:
            process.kill()
            process.wait()


def _numbers(path: Path) -> memoryview:
    """Map a witness's file as int64: number of spans, 0, then begin and end of each span in ns of CLOCK_MONOTONIC."""
    with path.open("r+b") as file:
        return memoryview(mmap.mmap(file.fileno(), 0)).cast("q")


def watch(path: Path, cpu: int) -> None:
    """Record delays of one processor in the file `path` until the parent process ends."""
    os.sched_setaffinity(0, {cpu})
    file, parent, account = _numbers(path), os.getppid(), os.open("/proc/self/schedstat", os.O_RDONLY)
    slept_ns, count, own_ns = time.monotonic_ns(), 0, _waited_ns(os.pread(account, ACCOUNT_BYTES, 0))
    while os.getppid() == parent and count < SPANS:
        time.sleep(PERIOD_S)
        now_ns, before_ns, own_ns = time.monotonic_ns(), own_ns, _waited_ns(os.pread(account, ACCOUNT_BYTES, 0))
        late_ns = now_ns - slept_ns - round(PERIOD_S * NS_PER_S) - (own_ns - before_ns)
        if late_ns > LEAST_S * NS_PER_S:
            count += 1
            file[2 * count], file[2 * count + 1] = now_ns - late_ns, now_ns
            file[0] = count
        slept_ns = time.monotonic_ns()


if __name__ == "__main__":
    watch(Path(sys.argv[1]), int(sys.argv[2]))
