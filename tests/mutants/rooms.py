"""The rooms (parts of the program) in which `make mutants` plants mistakes, and the tests of each room."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
MIN_PER_ROOM = 25
"""Smallest number of mutants of a room, if the total suffices and the room has as many places."""


class Room(NamedTuple):
    """Folder of sources (except its subfolder `without`) and folders or files of tests, from the tree's root."""

    sources: str
    tests: tuple[str, ...]
    compiled: bool
    """Whether tests run with compiled kernels: only if the sources contain no kernel, because compiling takes long."""
    without: str = ""


_RECORDING = (
    "tests/recording",
    "tests/panel/recordings/test_recordings.py",
    "tests/laws/test_replay.py",
    "tests/test_steps.py",
)
ROOMS = {
    "kernel": Room("rtloop/kernel", ("tests/kernel", "tests/engine", "tests/laws"), compiled=False),
    "laws": Room("rtloop/laws", ("tests/laws", "tests/kernel/test_inverse_hysteresis.py"), compiled=False),
    "engine": Room("rtloop/engine", ("tests/engine", "tests/laws", "tests/kernel/test_safety.py"), compiled=False),
    "supervision": Room(
        "rtloop/supervision",
        (
            *("tests/service/test_parking.py", "tests/service/test_stall.py", "tests/service/test_recording_state.py"),
            *("tests/service/test_other_users.py", "tests/service/test_binding.py", "tests/service/test_finding.py"),
            *("tests/service/test_short_runs.py", "tests/service/test_run.py", "tests/service/test_lock.py"),
            *("tests/service/test_python_driver.py", "tests/service/test_can_supervision.py", "tests/test_files.py"),
            *("tests/doctor/test_host_delay.py", "tests/doctor/test_conditions.py", "tests/recording/test_quota.py"),
            *("tests/recording/test_disk.py", "tests/recording/test_replaced.py"),
        ),
        compiled=True,
    ),
    "recording": Room("rtloop/recording", _RECORDING, compiled=True, without="rtloop/recording/replay"),
    "replay": Room("rtloop/recording/replay", (*_RECORDING, "tests/laws/test_coupled.py"), compiled=True),
    "changing": Room(
        "rtloop/service/changing",
        (
            *("tests/service/test_building.py", "tests/service/test_preview.py", "tests/service/test_reload.py"),
            *("tests/service/test_api.py", "tests/service/test_api_refusals.py", "tests/service/test_learn.py"),
            *("tests/service/test_retune.py", "tests/laws/test_coupled.py"),
        ),
        compiled=True,
    ),
    "analysis": Room(
        "rtloop/analysis",
        (
            *("tests/design/test_learning.py", "tests/design/test_coupled_loop.py", "tests/design/test_judgement.py"),
            *("tests/design/test_measured_loop.py", "tests/design/test_loop_analysis.py"),
            *("tests/design/test_compare_discrete.py", "tests/design/test_referee.py"),
            *("tests/design/test_running_loop.py", "tests/design/test_simulated.py", "tests/service/test_response.py"),
        ),
        compiled=True,
    ),
    "hil": Room(
        "hil",
        (
            *("tests/hil", "tests/test_kernels.py", "tests/engine/test_stale_cache.py", "tests/test_messages.py"),
            *("tests/drivers/test_sim_contract.py", "tests/drivers/test_shm_contract.py"),
            *("tests/drivers/test_board_losses.py", "tests/drivers/test_board_stale.py", "tests/test_files.py"),
            *("tests/service/test_other_users.py", "tests/service/test_binding.py"),
        ),
        compiled=False,
    ),
}


def room_sources(room: Room, tree: Path = ROOT) -> list[str]:
    """Return the room's modules, as paths from the root of the tree."""
    modules = sorted(path.relative_to(tree).as_posix() for path in (tree / room.sources).rglob("*.py"))
    return [path for path in modules if not (room.without and path.startswith(room.without + "/"))]


@cache
def room_tests(room: Room) -> list[str]:
    """Return the room's test files, as paths from the tree's root: those listed, then others that name its package."""
    listed = [
        path
        for place in room.tests
        for path in ([ROOT / place] if place.endswith(".py") else sorted((ROOT / place).glob("test_*.py")))
    ]
    return [path.relative_to(ROOT).as_posix() for path in dict.fromkeys([*listed, *_tests_that_name(room)])]


def _tests_that_name(room: Room) -> list[Path]:
    """Return the test files that contain the name of the room's package."""
    name = re.compile(rf"\b{re.escape('rtloop.' + room.sources.removeprefix('rtloop/').replace('/', '.'))}\b")
    return [path for path in sorted((ROOT / "tests").rglob("test_*.py")) if name.search(path.read_text("utf-8"))]


def shares(counts: dict[str, int], total: int, minimum: int = MIN_PER_ROOM) -> dict[str, int]:
    """Return each room's number of mutants: `minimum` if `total` suffices; the rest by its places."""
    base = min(minimum, total // len(counts))
    remainder, places_in_all = total - base * len(counts), sum(counts.values())
    exact = {name: remainder * count / places_in_all for name, count in counts.items()}
    numbers = {name: base + int(share) for name, share in exact.items()}
    largest = sorted(counts, key=lambda name: exact[name] % 1, reverse=True)
    for name in largest[: total - sum(numbers.values())]:
        numbers[name] += 1
    return {name: min(number, counts[name]) for name, number in numbers.items()}
