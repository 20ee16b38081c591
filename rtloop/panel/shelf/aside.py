"""What takes long, or much memory, in processes beside the panel, as nice as it is: few at a time, and not for ever."""

from __future__ import annotations

import asyncio
import json
import os
import sys
from contextlib import suppress
from typing import Any

from rtloop.errors import RtloopError
from rtloop.values import counted

AT_A_TIME, MOST_WAITING = 2, 8
TIMEOUT_S = 120.0
CALM = {"OPENBLAS_NUM_THREADS": "1"}


class Crowded(Exception):
    """So many wait already."""


class Failed(RtloopError):
    """What a process says that could not do what it was to."""


class Aside:
    """Runs Python modules as processes."""

    def __init__(self) -> None:
        self._turn = asyncio.Semaphore(AT_A_TIME)
        self._there = 0

    async def run(self, module: str, *arguments: object) -> dict[str, Any]:
        """The JSON object that `python -m module arguments` prints. Raises Crowded, or Failed with its `error`."""
        if self._there >= MOST_WAITING:
            raise Crowded(f"{counted(MOST_WAITING, 'request')} of this kind wait already; try again")
        self._there += 1
        try:
            async with self._turn:
                return await _said([sys.executable, "-m", module, *map(str, arguments)])
        finally:
            self._there -= 1


async def _said(command: list[str]) -> dict[str, Any]:
    pipe, nothing = asyncio.subprocess.PIPE, asyncio.subprocess.DEVNULL
    process = await asyncio.create_subprocess_exec(
        *command, stdin=nothing, stdout=pipe, stderr=nothing, env=os.environ | CALM
    )
    try:
        out, _ = await asyncio.wait_for(process.communicate(), TIMEOUT_S)
    except TimeoutError:
        raise Failed(f"not done within {TIMEOUT_S:g} s: the recording is too long for the page") from None
    finally:
        if process.returncode is None:
            with suppress(ProcessLookupError):
                process.kill()
            await process.wait()
    try:
        said = json.loads(out)
    except ValueError:
        raise Failed(f"{command[2]} ended with {process.returncode}") from None
    if "error" in said:
        raise Failed(said["error"])
    return said
