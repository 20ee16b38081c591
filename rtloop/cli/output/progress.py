"""A status line on the terminal; no output where the stream is not a terminal."""

from __future__ import annotations

from typing import IO, Self


class StatusLine:
    """A line on the terminal that states the present activity while a `with` block runs."""

    def __init__(self, text: str, stream: IO[str]) -> None:
        """Make the line, which a `with` block shows; without a terminal on `stream`, no line is shown."""
        self._status = None
        if stream.isatty():
            from rich.console import Console

            self._status = Console(file=stream, highlight=False).status(text)

    def __enter__(self) -> Self:
        if self._status:
            self._status.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._status:
            self._status.stop()

    def update(self, text: str) -> None:
        """Change the text of the line; no effect without a terminal."""
        if self._status:
            self._status.update(text)


class Counter(StatusLine):
    """A status line with a growing number, such as the ticks read."""

    def __init__(self, label: str, stream: IO[str]) -> None:
        """Begin with the label alone; `show` adds a number."""
        super().__init__(label, stream)
        self._label = label

    def show(self, count: int) -> None:
        """Show `count` before the label; no effect without a terminal."""
        self.update(f"{count:,} {self._label}")
