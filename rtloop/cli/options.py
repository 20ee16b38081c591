"""What the commands share: arguments, options, and how an error becomes one message and an exit code."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click

from rtloop.terminal.machine import echo_json

OUTPUT = click.Path(path_type=Path)
CONFIG = click.argument("config", type=OUTPUT)
FILES = click.argument("files", metavar="FILE...", type=OUTPUT, nargs=-1, required=True)
JSON = click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout, everything else on stderr.")


def fails_clearly(command: Callable[..., int | None]) -> Callable[..., None]:
    """Turn the project's errors into one message and the right exit code; never a traceback for a user's mistake."""

    @wraps(command)
    def wrapped(*args: Any, **kwargs: Any) -> None:
        from rtloop.drivers.errors import DriverError
        from rtloop.errors import ConfigError, RtloopError, UnavailableError

        try:
            code = command(*args, **kwargs) or 0
        except (RtloopError, DriverError) as error:
            code = UnavailableError.exit_code if isinstance(error, DriverError) else error.exit_code
            message = _with_lines(error) if isinstance(error, ConfigError) else str(error)
            click.echo(f"rtloop: {message}", err=True)
            if kwargs.get("as_json"):
                echo_json({"error": message, "exit_code": code})
        sys.exit(code)

    return wrapped


def require_text(file: Path) -> None:
    """Say at once that a file cannot be read, before a second goes into imports. Raises InputFileError."""
    from rtloop.configuration.text_files import read_text

    read_text(file)


def _with_lines(error: Any) -> str:
    """The faults of a configuration with the lines of its file."""
    from rtloop.configuration.toml_lines import numbered
    from rtloop.errors import fault_list

    return fault_list(error.source, numbered(error.faults, error.source))


class UnreadableInput(click.ClickException):
    """An input file that cannot be read."""

    exit_code = 66


class InputFile(click.File):
    """A text file to read, or `-`; one that cannot be read ends the command as every missing input does."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Open the file."""
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter as error:
            raise UnreadableInput(error.message) from None


class Seconds(click.ParamType):
    """A finite number of seconds above 0, or from 0 on."""

    name = "seconds"

    def __init__(self, *, zero: bool = False) -> None:
        self._zero = zero

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        """The number; a usage error where it is none that is allowed."""
        try:
            seconds = float(value)
        except ValueError:
            seconds = math.nan
        if not (0 < seconds < math.inf or (self._zero and seconds == 0)):
            self.fail(f"{value}: a number of seconds {'from' if self._zero else 'above'} 0 is needed", param, ctx)
        return seconds
