"""Output that several commands share: JSON or text, and progress."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from typing import TypeVar

import click

from rtloop.values import to_jsonable

Content = TypeVar("Content")


def echo_json(content: object, indent: int | None = None) -> None:
    """Print JSON on standard output, in one line without `indent`; null stands for NaN and infinity."""
    click.echo(json.dumps(to_jsonable(content), indent=indent, allow_nan=False))


def print_result(result: Content, as_json: bool, print_text: Callable[[Content], None]) -> None:
    """Print a result as one JSON object if `as_json`, else by `print_text`."""
    if as_json:
        echo_json(result)
    else:
        print_text(result)


def print_warnings(warnings: Iterable[object]) -> None:
    """Print warnings on stderr, each as a line "warning: TEXT"."""
    for warning in warnings:
        click.echo(f"warning: {warning}", err=True)
