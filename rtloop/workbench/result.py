"""Base class of results: one line for the prompt, the command's text for `print`, HTML for a notebook, JSON values."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

from rtloop.workbench.tables import render_html, render_text

if TYPE_CHECKING:
    from rich.console import Console


class Result(ABC):
    """A result. `str()` returns the text that the command prints, `as_dict()` the object of its option --json."""

    @abstractmethod
    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object that the command prints with --json; numbers that are not finite are None."""

    @abstractmethod
    def print_text(self, out: Console) -> None:
        """Print the text of the command on `out`, a console of rich."""

    @property
    @abstractmethod
    def headline(self) -> str:
        """The result in one line."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.headline}>"

    def __str__(self) -> str:
        return render_text(self.print_text)

    def _repr_html_(self) -> str:
        """Return the text of `print_text` with its colours as HTML, which a notebook shows."""
        return render_html(self.print_text)
