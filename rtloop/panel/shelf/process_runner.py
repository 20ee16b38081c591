"""What takes long, or much memory, in processes beside the panel, as nice as it is: few at a time, and not for ever."""

from __future__ import annotations

import asyncio
import json
import os
import sys
from contextlib import suppress
from typing import Any

from rtloop.errors import RtloopError
from rtloop.values import count_text

MAX_RUNNING, MAX_PENDING = 2, 8
TIMEOUT_S = 120.0
SINGLE_THREADED = {"OPENBLAS_NUM_THREADS": "1"}


class TooManyRequests(Exception):
    """So many wait already."""


class ProcessFailed(RtloopError):
    """What a process says that could not do what it was to; `code` is its exit code, where it says that."""

    def __init__(self, error: str, code: int | None = None) -> None:
        super().__init__(error)
        self.code = code


class ProcessRunner:
    """Runs Python modules as processes."""

    def __init__(
        self, max_running: int = MAX_RUNNING, max_pending: int = MAX_PENDING, timeout_s: float = TIMEOUT_S
    ) -> None:
        self._slots = asyncio.Semaphore(max_running)
        self._max_pending, self._timeout_s = max_pending, timeout_s
        self._pending = 0

    async def run(self, module: str, *arguments: object, stdin: str = "") -> dict[str, Any]:
        """The JSON object that `python -m module arguments` prints; it reads `stdin`, and ends where this is cancelled.

        Raises Crowded, or Failed with its `error`.
        """
        if self._pending >= self._max_pending:
            raise TooManyRequests(f"{count_text(self._max_pending, 'request')} of this kind wait already; try again")
        self._pending += 1
        try:
            async with self._slots:
                command = [sys.executable, "-m", module, *map(str, arguments)]
                return await _run_json(command, stdin.encode(), self._timeout_s)
        finally:
            self._pending -= 1


async def _run_json(command: list[str], stdin: bytes, timeout_s: float) -> dict[str, Any]:
    pipe, devnull = asyncio.subprocess.PIPE, asyncio.subprocess.DEVNULL
    process = await asyncio.create_subprocess_exec(
        *command, stdin=pipe, stdout=pipe, stderr=devnull, env=os.environ | SINGLE_THREADED
    )
    try:
        output, _ = await asyncio.wait_for(process.communicate(stdin), timeout_s)
    except TimeoutError:
        raise ProcessFailed(
            f"not done within {timeout_s:g} s: it takes too long for the page; use the command line"
        ) from None
    finally:
        if process.returncode is None:
            with suppress(ProcessLookupError):
                process.kill()
            await process.wait()
    try:
        result = json.loads(output)
    except ValueError:
        raise ProcessFailed(f"{command[2]} ended with {process.returncode}") from None
    if "error" in result:
        raise ProcessFailed(result["error"], result.get("exit_code"))
    return result
