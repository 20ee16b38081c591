"""One row of the table: a fault on real processes, what must happen, and what was measured."""

from __future__ import annotations

import subprocess
import tempfile
import traceback
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from rtloop.errors import RtloopError
from tests.faults.account import Account, account
from tests.faults.bench import Bench
from tests.faults.configuration import Bounds


class NotPossible(Exception):
    """This host does not permit the fault; the message says why."""


@dataclass
class Measured:
    """What a fault is judged by."""

    safe_ms: float | None = None
    lost_allowed: bool = False
    exit_code: int = 0
    note: str = ""
    extra: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Fault:
    """`inject` raises AssertionError where what must happen does not."""

    name: str
    must: str
    inject: Callable[[Bench], Measured]
    changes: tuple[tuple[str, str], ...] = ()
    card: bool = False
    environment: Callable[[Path], dict[str, str]] = lambda _: {}
    around: Callable[[Path], AbstractContextManager[None]] | None = None
    drives: bool = True
    """Whether the loop drives before the fault comes."""


@dataclass
class Row:
    """A row of the table, with the verdict: no problems."""

    fault: Fault
    measured: Measured = field(default_factory=Measured)
    account: Account = field(default_factory=lambda: Account(0, 0, 0, []))
    stalled_ms: float = 0.0
    """What the host took on the way to the safe output."""
    largest_v: float = 0.0
    step_v: float = 0.0
    window_v: float = 0.0
    bounds: Bounds = field(default_factory=lambda: Bounds(0.0, 0.0, 0.0))
    problems: list[str] = field(default_factory=list)
    skipped: str = ""


def measure(fault: Fault) -> Row:
    """Bring a fault about on a bench of its own and judge what came of it."""
    row = Row(fault)
    with tempfile.TemporaryDirectory(prefix="rtloop-fault-") as name, _surroundings(fault, Path(name)):
        try:
            given = {"card": fault.card, "environment": fault.environment(Path(name)), "strict": True}
            with Bench(Path(name), *fault.changes, **given) as bench:
                row.bounds = bench.bounds
                if fault.drives:
                    bench.await_drive()
                _judge(row, bench)
        except NotPossible as reason:
            row.skipped = str(reason)
        except (AssertionError, RtloopError, subprocess.TimeoutExpired) as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            row.problems.append(str(error) or f"{where.name}: {where.line}")
    return row


@contextmanager
def _surroundings(fault: Fault, folder: Path) -> Iterator[None]:
    if fault.around is None:
        yield
    else:
        with fault.around(folder):
            yield


def _judge(row: Row, bench: Bench) -> None:
    row.measured = measured = row.fault.inject(bench)
    row.stalled_ms = bench.stalled_ms
    row.problems += measured.extra
    code = bench.stop()
    if code != measured.exit_code:
        row.problems.append(f"exit code {code}, not {measured.exit_code}; {bench.log()[-600:]}")
    bench.witness()
    row.largest_v = max(seen.largest_v for seen in bench.witnessed)
    row.step_v = max(seen.largest_step_v for seen in bench.witnessed)
    row.window_v = max(seen.largest_window_v for seen in bench.witnessed)
    row.problems += [problem for seen in bench.witnessed for problem in seen.problems(row.bounds)]
    if bench.seen().last_v != 0.0:
        row.problems.append(f"the output is at {bench.seen().last_v:.3f} V in the end")
    row.account = account(bench.folder / "recordings", bench.blocks)
    row.problems += row.account.problems
    if row.account.lost and not measured.lost_allowed:
        row.problems.append(f"{row.account.lost} ticks lost")
    if "Traceback" in bench.log():
        row.problems.append(f"a traceback: {bench.log()[-1500:]}")
