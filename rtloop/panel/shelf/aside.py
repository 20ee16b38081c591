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

AT_A_TIME, MOST_WAITING = 2, 8
TIMEOUT_S = 120.0
CALM = {"OPENBLAS_NUM_THREADS": "1"}


class Crowded(Exception):
    """So many wait already."""


class Failed(RtloopError):
    """What a process says that could not do what it was to; `code` is its exit code, where it says that."""

    def __init__(self, error: str, code: int | None = None) -> None:
        super().__init__(error)
        self.code = code


class Aside:
    """Runs Python modules as processes."""

    def __init__(
        self, at_a_time: int = AT_A_TIME, most_waiting: int = MOST_WAITING, timeout_s: float = TIMEOUT_S
    ) -> None:
        self._turn = asyncio.Semaphore(at_a_time)
        self._most_waiting, self._timeout_s = most_waiting, timeout_s
        self._there = 0

    async def run(self, module: str, *arguments: object, stdin: str = "") -> dict[str, Any]:
        """The JSON object that `python -m module arguments` prints; it reads `stdin`, and ends where this is cancelled.

        Raises Crowded, or Failed with its `error`.
        """
        if self._there >= self._most_waiting:
            raise Crowded(f"{count_text(self._most_waiting, 'request')} of this kind wait already; try again")
        self._there += 1
        try:
            async with self._turn:
                command = [sys.executable, "-m", module, *map(str, arguments)]
                return await _said(command, stdin.encode(), self._timeout_s)
        finally:
            self._there -= 1


async def _said(command: list[str], stdin: bytes, timeout_s: float) -> dict[str, Any]:
    pipe, devnull = asyncio.subprocess.PIPE, asyncio.subprocess.DEVNULL
    process = await asyncio.create_subprocess_exec(
        *command, stdin=pipe, stdout=pipe, stderr=devnull, env=os.environ | CALM
    )
    try:
        output, _ = await asyncio.wait_for(process.communicate(stdin), timeout_s)
    except TimeoutError:
        raise Failed(f"not done within {timeout_s:g} s: it takes too long for the page; use the command line") from None
    finally:
        if process.returncode is None:
            with suppress(ProcessLookupError):
                process.kill()
            await process.wait()
    try:
        result = json.loads(output)
    except ValueError:
        raise Failed(f"{command[2]} ended with {process.returncode}") from None
    if "error" in result:
        raise Failed(result["error"], result.get("exit_code"))
    return result
