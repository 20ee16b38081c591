"""Commands of the command line, run in this process as a user types them."""

from __future__ import annotations

import json
from typing import Any

from click.testing import CliRunner, Result

from rtloop.cli import main


def run(*arguments: Any) -> Result:
    """Run `rtloop ARGUMENTS`; return its exit code and output. An exception that is no exit fails the test."""
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


def answer(*arguments: Any, code: int = 0) -> dict[str, Any]:
    """Run `rtloop ARGUMENTS --json`, which must end with `code`; return its JSON object. NaN fails the test."""
    result = run(*arguments, "--json")
    assert result.exit_code == code, result.output
    return json.loads(result.stdout, parse_constant=_refuse_constant)


def _refuse_constant(constant: str) -> None:
    raise AssertionError(f"{constant} is no JSON")
