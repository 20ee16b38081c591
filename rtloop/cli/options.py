"""Arguments, options and parameter types that several commands share."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from os import PathLike

OUTPUT = click.Path(path_type=Path, readable=False)
"""A path; a file that cannot be read is reported by its reader, with exit code 66, as a missing one is."""


class OutputPath(click.Path):
    """A path to write to; `-`, the standard output of other programs, is refused."""

    def __init__(self) -> None:
        """Take any path; the writer reports one that cannot be written."""
        super().__init__(path_type=Path, readable=False)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return `value` as a Path. Fails with a usage error for "-"."""
        if os.fspath(value) == "-":
            self.fail("value is -; allowed: the path of a file or folder, such as ./- for one of this name. "
                      "rtloop writes no file to the standard output", param, ctx)  # fmt: skip
        return super().convert(value, param, ctx)


TARGET = OutputPath()
CONFIG = click.argument("config", type=OUTPUT)


FILES = click.argument("files", metavar="FILE...", type=OUTPUT, nargs=-1, required=True)
JSON = click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout, everything else on stderr.")


class UnreadableInput(click.ClickException):
    """Error of an unreadable input file: exit code 66."""

    exit_code = 66


class InputFile(click.File):
    """A text file to read, or `-` for stdin; an unreadable file ends the command with exit code 66.

    Bytes that are no UTF-8 become the character �, so that the command refuses them where they stand.
    """

    def __init__(self) -> None:
        """Read files as UTF-8, with the character � for bytes that are no UTF-8."""
        super().__init__(encoding="utf-8", errors="replace")

    def convert(
        self, value: str | PathLike[str] | IO[str], param: click.Parameter | None, ctx: click.Context | None
    ) -> IO[str]:
        """Return the file at the path `value`, or stdin for "-", open for reading text.

        Raises UnreadableInput if it cannot be opened.
        """
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter as error:
            raise UnreadableInput(error.message) from None


class Seconds(click.ParamType):
    """A finite number of seconds above 0, or from 0 on."""

    name = "seconds"

    def __init__(self, *, allows_zero: bool = False) -> None:
        """Allow numbers above 0, with `allows_zero` also 0."""
        self._allows_zero = allows_zero

    def convert(self, value: str | float, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return `value` as seconds. Fails with a usage error unless it is finite and above 0, or 0 where allowed."""
        try:
            seconds = float(value)
        except ValueError:
            seconds = math.nan
        if not (0 < seconds < math.inf or (self._allows_zero and seconds == 0)):
            bound = ", 0 or more" if self._allows_zero else " above 0"
            self.fail(f"value is {value}; allowed: a finite number of seconds{bound}", param, ctx)
        return seconds


class MatchingText(click.ParamType):
    """A text that matches a regular expression; `rule` states in words what is allowed."""

    def __init__(self, name: str, pattern: str, rule: str) -> None:
        """Allow texts that match `pattern` as a whole; `name` is the type in the help, `rule` the pattern in words."""
        self.name, self._pattern, self._rule = name, pattern, rule

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return `value` unchanged. Fails with a usage error unless the pattern matches it as a whole."""
        if not re.fullmatch(self._pattern, value):
            self.fail(f"value is {value!r}; allowed: {self._rule}", param, ctx)
        return value


class NumberList(click.ParamType):
    """Numbers, separated by commas."""

    name = "numbers"

    def convert(
        self, value: str | tuple[float, ...], param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """Return the comma-separated numbers of a text; a tuple unchanged. Fails with a usage error for other texts."""
        if isinstance(value, tuple):
            return value
        try:
            return tuple(float(part) for part in value.split(","))
        except ValueError:
            self.fail(f"value is {value}; allowed: numbers separated by commas", param, ctx)


class PositiveFloat(click.FloatRange):
    """A number above 0; NaN is refused."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return `value` as a float. Fails with a usage error for NaN, a number outside the range of this type, and a
        text that is no number.
        """
        number = super().convert(value, param, ctx)
        return self.fail(f"value is {value}; allowed: a number above 0", param, ctx) if math.isnan(number) else number
