"""What programs read in place of words: one line of JSON."""

from __future__ import annotations

import json
from typing import Any

import click

from rtloop.values import to_jsonable


def echo_json(content: Any, indent: int | None = None) -> None:
    """Say it on standard output, with null for what is no finite number: strict readers refuse NaN."""
    click.echo(json.dumps(to_jsonable(content), indent=indent, allow_nan=False))
