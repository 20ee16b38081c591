"""Base models of the options of laws in a configuration; the options of each law derive from one of them."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, PrivateAttr

from rtloop.foundation.options import Options
from rtloop.hysteresis.play_model import PlayModel

SHIPPED_PREFIX = "rtloop."
"""Prefix of the modules of this package; the module of a user law has another name."""


class LawOptions(Options):
    """Base class of the options of a law."""

    kind: str = ""
    """Name of the law; without `kind` and `file` it is `transfer` for a controller, `prandtl_ishlinskii` for a
    feedforward."""
    file: str | None = None
    """Python file that defines the law, relative to the configuration's."""
    _law: Any = PrivateAttr(None)

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Build the validator of a user law's options with their class, so that a fault is reported with its line."""
        if not cls.__module__.startswith(SHIPPED_PREFIX):
            cls.model_rebuild(raise_errors=False)  # A name that the text defines further down is no fault.

    @property
    def law(self) -> Any:
        """`LawReference` of the law that has these options; None if `bind` was not called."""
        return self._law

    def bind(self, law: Any) -> None:
        """Set the `LawReference` of the law that has these options; the options are immutable otherwise."""
        self._law = law

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Pickle the options of a user law as `LawReference` and values, other options as usual.

        Another process must first run the law's text, which defines the class of the options.
        """
        if self._law is None or not self._law.text:
            return super().__reduce_ex__(protocol)
        return self._law.restore_options, (self.model_dump(exclude_unset=True),)


class FeedforwardOptions(LawOptions):
    """Base of a feedforward's options."""

    def actuator(self) -> PlayModel:
        """Return the actuator that the feedforward inverts, as a sum of plays.

        An actuator without hysteresis is a single play of threshold 0. Experiments and cautions use the actuator. The
        options of every feedforward must define this method: the base class raises NotImplementedError.
        """
        raise NotImplementedError


class ControllerOptions(LawOptions):
    """Base of a controller's options."""

    allow_unstable: bool = False
    """Run although the loop is unstable on the axis's model."""
    axes: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Names of a coupled controller's axes, the configured axis first; empty for this axis alone."""
