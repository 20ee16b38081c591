"""Python modules run as processes beside the panel, for long or large work: few at a time, with a time limit."""

from __future__ import annotations

import asyncio
import json
import shlex
from contextlib import suppress

from rtloop.errors import RtloopError
from rtloop.foundation.children import child_environment, python_command
from rtloop.service.api.lanes import TooManyRequests
from rtloop.values import count_text

MAX_RUNNING, MAX_PENDING = 2, 8
TIMEOUT_S = 120.0
SINGLE_THREADED = {"OPENBLAS_NUM_THREADS": "1"}


class ProcessFailed(RtloopError):
    """A process reported an error, took too long or printed no result.

    `code` is the exit code that it reported, else None.
    """

    def __init__(self, error: str, code: int | None = None) -> None:
        """Store the message and the exit code that the process reported."""
        super().__init__(error)
        self.code = code


class ProcessRunner:
    """Runs Python modules as processes: at most `max_running` at a time, `max_unfinished` including the waiting ones.

    Each is killed after `timeout_s` seconds, not counting its wait.
    """

    def __init__(
        self, max_running: int = MAX_RUNNING, max_unfinished: int = MAX_PENDING, timeout_s: float = TIMEOUT_S
    ) -> None:
        """Store the limits; no process runs yet."""
        self._slots = asyncio.Semaphore(max_running)
        self._max_unfinished, self._timeout_s = max_unfinished, timeout_s
        self._pending = 0

    async def run(self, module: str, *arguments: object, stdin: str = "") -> dict[str, object]:
        """Run `python -m module arguments` with the input `stdin` and return the JSON object that it prints.

        The process is killed if this call is cancelled. Raises TooManyRequests if `max_unfinished` run or wait, and
        ProcessFailed for an object with the key `error`, for output that is no JSON, and after `timeout_s`.
        """
        if self._pending >= self._max_unfinished:
            raise TooManyRequests(
                f"{count_text(self._max_unfinished, 'request')} of this kind run or wait already; try again later"
            )
        self._pending += 1
        try:
            async with self._slots:
                return await _run_json(python_command(module, *arguments), stdin.encode(), self._timeout_s)
        finally:
            self._pending -= 1


async def _run_json(command: list[str], stdin: bytes, timeout_s: float) -> dict[str, object]:
    """Run a command and return the JSON object that it prints.

    The process is killed after `timeout_s`, and if this call is cancelled. `stdin` is its input; its stderr is
    discarded. Raises ProcessFailed as `ProcessRunner.run`.
    """
    pipe, devnull = asyncio.subprocess.PIPE, asyncio.subprocess.DEVNULL
    process = await asyncio.create_subprocess_exec(
        *command, stdin=pipe, stdout=pipe, stderr=devnull, env=child_environment(SINGLE_THREADED)
    )
    try:
        output, _ = await asyncio.wait_for(process.communicate(stdin), timeout_s)
    except TimeoutError:
        remedy = "run it in a terminal, where it has no time limit"
        raise ProcessFailed(f"`{_command_text(command)}` did not finish within {timeout_s:g} s; {remedy}") from None
    finally:
        if process.returncode is None:
            with suppress(ProcessLookupError):
                process.kill()
            await process.wait()
    try:
        result = json.loads(output)
    except ValueError:
        raise ProcessFailed(
            f"`{_command_text(command)}` ended with exit code {process.returncode} and without a result; run it in a "
            "terminal, which shows its messages"
        ) from None
    if "error" in result:
        raise ProcessFailed(result["error"], result.get("exit_code"))
    return result


def _command_text(command: list[str]) -> str:
    """Return the command line for a terminal, quoted: `rtloop …`, or `python -m MODULE …` for another module."""
    words = command[command.index("-m") + 1 :]
    return shlex.join(words if words[0] == "rtloop" else ["python", "-m", *words])
