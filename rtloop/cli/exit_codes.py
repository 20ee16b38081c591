"""Errors of the project as one message on stderr and an exit code."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rtloop.cli.output import echo_json

if TYPE_CHECKING:
    from rtloop.errors import ConfigError


def report_errors(command: Callable[..., int | None]) -> Callable[..., None]:
    """Return `command` wrapped: it ends the process with an exit code, and prints an RtloopError or DriverError as a
    message on stderr, without a traceback.

    `command` returns its exit code, or None for 0. If its option `as_json` is set, the error is printed as JSON too:
    {error, exit_code}. The exit code after an error is set by the error's class; a DriverError counts as an
    UnavailableError. Other errors are raised.
    """

    @wraps(command)
    def wrapped(*args: object, **kwargs: object) -> None:
        """Run the command, print an error of the project, and end the process with the exit code."""
        from rtloop.drivers.errors import DriverError
        from rtloop.errors import ConfigError, RtloopError, UnavailableError

        try:
            code = command(*args, **kwargs) or 0
        except (RtloopError, DriverError) as error:
            code = UnavailableError.exit_code if isinstance(error, DriverError) else error.exit_code
            message = _message_with_lines(error) if isinstance(error, ConfigError) else str(error)
            click.echo(f"rtloop: {message}", err=True)
            if kwargs.get("as_json"):
                echo_json({"error": message, "exit_code": code})
        sys.exit(code)

    return wrapped


def require_readable(file: Path) -> None:
    """Raise InputFileError if `file` cannot be read as text. To be called before slow imports."""
    from rtloop.configuration.text_files import read_text

    read_text(file)


def _message_with_lines(error: ConfigError) -> str:
    """Return a text that lists the faults of a ConfigError, each with its line in the file if that can be found."""
    from rtloop.configuration.toml_lines import numbered
    from rtloop.errors import fault_list

    return fault_list(error.source, numbered(error.faults, error.source))
