"""What every law may be told by a configuration; a law's own model derives from one of these."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, PrivateAttr

from rtloop.foundation.options import Options
from rtloop.hysteresis.play_model import PlayModel


class LawOptions(Options):
    """Base of what a configuration says of a law."""

    kind: str = ""
    """Name of the law; that of the shipped one by default."""
    file: str | None = None
    """Python file that defines the law, relative to the configuration's."""
    _law: Any = PrivateAttr(None)

    @property
    def law(self) -> Any:
        """The `LawReference` that these options are of; None where they were made without one."""
        return self._law

    def bind(self, law: Any) -> None:
        """Note what these options are of."""
        self._law = law

    def __reduce_ex__(self, protocol: Any) -> Any:
        """The model of a law from a file is known to the process alone that ran the file: what was said is pickled."""
        if self._law is None or not self._law.text:
            return super().__reduce_ex__(protocol)
        return _restore_options, (self._law, self.model_dump(exclude_unset=True))


def _restore_options(law: Any, values: dict[str, Any]) -> LawOptions:
    from rtloop.laws.registry import law_class

    options = law_class(law).options_model.model_validate(values)
    options.bind(law)
    return options


class FeedforwardOptions(LawOptions):
    """Base of what it says of a feedforward."""

    def actuator(self) -> PlayModel:
        """The actuator that it undoes, as a sum of plays; one play of threshold 0 where there is no hysteresis.

        Experiments and cautions are judged by it. Every feedforward's options must say it.
        """
        raise NotImplementedError


class ControllerOptions(LawOptions):
    """Base of what it says of a controller."""

    allow_unstable: bool = False
    """Run although the loop is unstable on the axis's model."""
    axes: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Axes that a coupled controller has, this one first and the others behind it; none is this one alone."""
