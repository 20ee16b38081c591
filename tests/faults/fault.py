"""One row of the fault table: a fault injected into real processes, the required behaviour, and the verdict."""

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
class Outcome:
    """Result of an injected fault: time to the safe output in ms, and effects that the verdict has to accept."""

    safe_ms: float | None = None
    lost_allowed: bool = False
    exit_code: int = 0
    note: str = ""


@dataclass(frozen=True)
class Fault:
    """A fault of the table. `must` is the required behaviour as a text.

    `inject` brings the fault about and returns its outcome. It raises AssertionError if the service does not behave as
    required. `changes` edit the configuration, `environment` adds variables, `around` is entered before the bench.
    """

    name: str
    must: str
    inject: Callable[[Bench], Outcome]
    changes: tuple[tuple[str, str], ...] = ()
    card: bool = False
    environment: Callable[[Path], dict[str, str]] = lambda _: {}
    around: Callable[[Path], AbstractContextManager[None]] | None = None
    drives: bool = True
    """Whether the fault is injected only when the loop drives its output."""


@dataclass
class Row:
    """A row of the table: the outcome, the account of the ticks, the drive in V. The row passes without `problems`."""

    fault: Fault
    outcome: Outcome = field(default_factory=Outcome)
    account: Account = field(default_factory=lambda: Account(0, 0, 0, []))
    stalled_ms: float = 0.0
    """Time in ms that the host stalled between the fault and the safe output."""
    largest_v: float = 0.0
    step_v: float = 0.0
    window_v: float = 0.0
    bounds: Bounds = field(default_factory=lambda: Bounds(0.0, 0.0, 0.0))
    problems: list[str] = field(default_factory=list)
    skipped: str = ""


def measure(fault: Fault) -> Row:
    """Inject a fault into a new bench and return its row of the table, with all problems."""
    row = Row(fault)
    with tempfile.TemporaryDirectory(prefix="rtloop-fault-") as name, _surroundings(fault, Path(name)):
        try:
            options = {"card": fault.card, "environment": fault.environment(Path(name)), "strict": True}
            with Bench(Path(name), *fault.changes, **options) as bench:
                row.bounds = bench.bounds
                if fault.drives:
                    bench.await_drive()
                _judge(row, bench)
        except NotPossible as reason:
            row.skipped = str(reason)
        except (AssertionError, RtloopError, subprocess.TimeoutExpired) as error:
            frame = traceback.extract_tb(error.__traceback__)[-1]
            row.problems.append(str(error) or f"{frame.name}: {frame.line}")
    return row


@contextmanager
def _surroundings(fault: Fault, folder: Path) -> Iterator[None]:
    """Enter the context manager `fault.around`, where the fault has one."""
    if fault.around is None:
        yield
    else:
        with fault.around(folder):
            yield


def _judge(row: Row, bench: Bench) -> None:
    """Inject the fault of a row, stop the service, and fill in the row's figures and problems."""
    row.outcome = outcome = row.fault.inject(bench)
    row.stalled_ms = bench.stalled_ms
    code = bench.stop()
    if code != outcome.exit_code:
        row.problems.append(f"exit code {code}, not {outcome.exit_code}; {bench.log()[-600:]}")
    bench.store_record()
    row.largest_v = max(record.largest_v for record in bench.records)
    row.step_v = max(record.largest_step_v for record in bench.records)
    row.window_v = max(record.largest_window_v for record in bench.records)
    row.problems += [problem for record in bench.records for problem in record.problems(row.bounds)]
    if bench.output_record().last_v != 0.0:
        row.problems.append(f"the output is at {bench.output_record().last_v:.3f} V in the end")
    row.account = account(bench.folder / "recordings", bench.blocks)
    row.problems += row.account.problems
    if row.account.lost and not outcome.lost_allowed:
        row.problems.append(f"{row.account.lost} ticks lost")
    if "Traceback" in bench.log():
        row.problems.append(f"a traceback: {bench.log()[-1500:]}")
