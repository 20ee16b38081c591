"""Commands as somebody gives them, in this process."""

from __future__ import annotations

import json
from typing import Any

from click.testing import CliRunner, Result

from rtloop.cli import main


def run(*arguments: Any) -> Result:
    """What came of it; an exception that reached the terminal is a fault."""
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


def answer(*arguments: Any, code: int = 0) -> dict[str, Any]:
    """Its one JSON object, which strict readers take."""
    result = run(*arguments, "--json")
    assert result.exit_code == code, result.output
    return json.loads(result.stdout, parse_constant=_refused)


def _refused(constant: str) -> None:
    raise AssertionError(f"{constant} is no JSON")
