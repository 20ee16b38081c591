"""What programs read in place of words: one line of JSON."""

from __future__ import annotations

import json
from typing import Any

import click

from rtloop.values import plain


def echo_json(content: Any, indent: int | None = None) -> None:
    """Say it on standard output, with null for what is no finite number: strict readers refuse NaN."""
    click.echo(json.dumps(plain(content), indent=indent, allow_nan=False))
