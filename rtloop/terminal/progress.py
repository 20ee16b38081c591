"""One line on the terminal that changes while something takes long; nothing where the stream is no terminal."""

from __future__ import annotations

from typing import IO, Self

from rich.console import Console


class StatusLine:
    """A line that says what is going on."""

    def __init__(self, text: str, stream: IO[str]) -> None:
        console = Console(file=stream, highlight=False)
        self._status = console.status(text) if console.is_terminal else None

    def __enter__(self) -> Self:
        if self._status:
            self._status.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._status:
            self._status.stop()

    def update(self, text: str) -> None:
        """Say something else."""
        if self._status:
            self._status.update(text)


class Counter(StatusLine):
    """A number that grows."""

    def __init__(self, label: str, stream: IO[str]) -> None:
        super().__init__(label, stream)
        self._label = label

    def show(self, count: int) -> None:
        """The number so far."""
        self.update(f"{count:,} {self._label}")
