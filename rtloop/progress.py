"""A number that grows on the terminal while something takes long."""

from __future__ import annotations

from typing import IO

from rich.console import Console


class Counter:
    """A number that grows, on a terminal."""

    def __init__(self, label: str, stream: IO[str]) -> None:
        console = Console(file=stream, highlight=False)
        self._label = label
        self._status = console.status(label) if console.is_terminal else None

    def __enter__(self) -> Counter:
        if self._status:
            self._status.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._status:
            self._status.stop()

    def show(self, count: int) -> None:
        """The number so far."""
        if self._status:
            self._status.update(f"{count:,} {self._label}")
