"""Base class of identified models: the section that they become in a configuration, and their picture."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from rtloop.design.figures import save_figure
from rtloop.design.identification.model_sections import write_new_file
from rtloop.workbench.arguments import as_path
from rtloop.workbench.result import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Warn = Callable[[Iterable[str]], None]
"""Receiver of warnings, before the model is fitted."""


class WarningCollector:
    """Receiver that keeps warnings, as `warnings`, and passes them to another receiver at once."""

    def __init__(self, warn: Warn) -> None:
        """Begin without warnings; `warn` is the other receiver."""
        self.warnings: list[str] = []
        self._warn = warn

    def __call__(self, messages: Iterable[str]) -> None:
        """Append the messages to `warnings`, and pass them to the other receiver as a list."""
        texts = list(messages)
        self.warnings += texts
        self._warn(texts)


class IdentifiedModel(Result):
    """An identified model, which `write` stores as a section of a configuration.

    `output` and `picture` are the files that `write` and `save_plot` wrote; None before.
    """

    output: Path | None = None
    picture: Path | None = None

    @property
    @abstractmethod
    def section(self) -> str:
        """The model as TOML. Raises UnsuitableData for hysteresis without an inverse."""

    @abstractmethod
    def plot(self) -> Figure:
        """Return a picture of the model beside its recordings. Raises MissingExtra without matplotlib."""

    def write(self, path: str | Path) -> Path:
        """Write the section to a new file. Returns its path, which is also stored as `output`.

        Raises OutputError if the file exists or cannot be written, UnsuitableData for hysteresis without an inverse.
        """
        target = as_path(path, "write: path")
        write_new_file(target, self.section)
        self.output = target
        return target

    def save_plot(self, path: str | Path) -> Path:
        """Write the picture as PNG, over an existing file. Returns its path, which is also stored as `picture`.

        Raises OutputError for a file that cannot be written, MissingExtra without matplotlib.
        """
        target = as_path(path, "save_plot: path")
        save_figure(self.plot(), target)
        self.picture = target
        return target
