"""The rooms that run beside the loop take clocks, pauses, locks and threads from one place."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import rtloop

PACKAGE = Path(rtloop.__file__).parent
ROOMS = ("service", "supervision", "client", "panel", "recording/capture")
FUNCTIONS = {
    "time": {"time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "sleep"},
    "threading": {"Lock", "RLock", "Condition", "Event", "Semaphore", "Thread", "Timer", "Barrier"},
}
COMPILED = "compiled code that runs without the interpreter"
PIPES = "waits for the pipes of a process"
ALLOWED = {
    ("supervision/heart.py", "threading.Thread"): COMPILED,
    ("supervision/child.py", "threading.Thread"): PIPES,
}


def calls(module: Path) -> Iterator[str]:
    """Yield "module.function" of each call of FUNCTIONS, however it was imported."""
    tree, names = ast.parse(module.read_text("utf-8")), dict[str, str]()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module in FUNCTIONS:
            names |= {item.asname or item.name: f"{node.module}.{item.name}" for item in node.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute | ast.Name):
            text = names.get(ast.unparse(node), ast.unparse(node))
            library, _, function = text.rpartition(".")
            if function in FUNCTIONS.get(library, ()) and isinstance(node.ctx, ast.Load):
                yield text


def test_time_locks_and_threads_come_from_one_place() -> None:
    found = {
        (path.relative_to(PACKAGE).as_posix(), call)
        for room in ROOMS
        for path in (PACKAGE / room).rglob("*.py")
        for call in calls(path)
    }
    used_as_types = {pair for pair in found if pair[1] in ("threading.Event", "threading.Thread")} - ALLOWED.keys()
    assert found - used_as_types == ALLOWED.keys()
    for name, call in used_as_types:  # a type of a parameter, never called
        source = (PACKAGE / name).read_text("utf-8")
        assert f"{call.rpartition('.')[2]}(" not in source, f"{name} starts its own: use rtloop.foundation.timing"
