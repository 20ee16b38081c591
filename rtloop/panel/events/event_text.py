"""Texts of events; the page shows kind, tick and operator beside them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from rtloop.kernel.reference import Generator
from rtloop.recording.file.topics.events import RECORDER, Event
from rtloop.values import count_text

UM = " µm"
OFF, RAW = "off", "raw"
"""Texts of modes. Without a schedule in its configuration a service starts with the outputs off."""
_HOLD = Generator.HOLD.name.lower()


class PlayedReference(NamedTuple):
    """Reference that an axis plays: the kind of its generator, its text (may be empty), and the value of a constant one
    in µm (V in mode raw), None if it is not constant or no event reports it.
    """

    kind: str
    text: str
    value: float | None = None


class RunState:
    """References and mode of a run after its events so far, so that a change is shown with its old value."""

    def __init__(self, axes: dict[str, dict[str, Any]], mode: str | None = None) -> None:
        """Begin with the references of `axes`, tables [axis] by name, and the text of the first mode; None: unknown."""
        self.references = {name: _configured_reference(axis.get("reference") or {}) for name, axis in axes.items()}
        """Reference of each axis whose reference is known. Replaced as a whole: other threads read it."""
        self._mode = mode

    def describe_change(self, event: Event) -> str:
        """Return the text of the run's next event, and store its reference or mode for the next change.

        A change of reference or mode reads `0 µm → 12.5 µm` or `closed loop → off`. If the old value is unknown or the
        mode is the same, and for every other event, the text is the result of `event_text`.
        """
        kind, text = event["kind"], event_text(event, unit=" V" if self._mode == RAW else UM)
        if kind == "set_reference":
            previous = self.references.get(event["axis"])
            reference = _started_reference(event["what"]["values"], text)
            changed_axes = self.references if event["axis"] is None else [event["axis"]]
            self.references = self.references | dict.fromkeys(changed_axes, reference)
            return f"{previous.text} → {text}" if previous is not None and previous.text else text
        if kind == "set_mode":
            previous_mode, self._mode = self._mode, text
            if RAW in (previous_mode, text):
                # The loop holds the present value, which no event reports.
                self.references = dict.fromkeys(self.references, PlayedReference(_HOLD, ""))
            return f"{previous_mode} → {text}" if previous_mode not in (None, text) else text
        if kind == "tripped":
            self._mode = OFF
        return text


def _configured_reference(reference: dict[str, Any]) -> PlayedReference:
    """Return the reference that a table [axis.reference] configures, in µm; its value is None unless it is constant."""
    kind = reference.get("kind", _HOLD)
    value = float(reference.get("value", 0.0)) if kind == _HOLD else None
    return PlayedReference(kind, reference_text(reference), value)


def _started_reference(values: Sequence[float | None], text: str) -> PlayedReference:
    """Return the reference that an event `set_reference` starts; its value is None unless it is constant.

    `values` are [kind, *parameters] of its generator, `text` is the event's text.
    """
    kind = int(values[0] or 0)
    name = Generator(kind).name.lower() if kind in set(Generator) else ""
    return PlayedReference(name, text, float(values[1] or 0.0) if kind == Generator.HOLD else None)


def reference_text(reference: dict[str, Any]) -> str:
    """Return the text of a configuration's table [axis.reference], with values in µm.

    The text is "" for other kinds than hold, sine and triangle; a missing kind is hold, a missing value 0.
    """
    match reference.get("kind", "hold"):
        case "hold":
            return _generator_text([Generator.HOLD, float(reference.get("value", 0.0)), *[0.0] * 4], UM)
        case "sine" | "triangle" as kind:
            values = [float(reference.get(key, 0.0)) for key in ("amplitude", "frequency_hz", "offset")]
            return _generator_text([Generator[kind.upper()], *values, 0.0, 0.0], UM)
    return ""


def event_text(event: Event, unit: str = "") -> str:
    """Return the text of an event of `event_from_message` or `LateEpisodes`.

    The text is "" for a kind that needs no text, such as a reset. `unit`, such as " µm", follows each value of a
    reference that is a position, or in mode raw a drive.
    """
    details = event["what"]
    match event["kind"]:
        case "set_reference":
            return _generator_text([float(value or 0.0) for value in details["values"]], unit)
        case "set_mode":
            return details["mode"].replace("_", " ")
        case "load_law":
            return details.get("change") or ("another controller" if details["values"][0] else "other coefficients")
        case "tripped":
            return details["reason"] or ", ".join(details["causes"])
        case "recovery":
            return f"{details['step']}: {details['reason']}" if details["reason"] else details["step"]
        case "periods_missed":
            return f"{count_text(details['late_ticks'], 'late tick')}, worst {details['worst_ms']:.3g} ms"
        case "gap":
            verb = "recorded" if event["who"] == RECORDER else "shown"
            return f"{count_text(details['ticks'], 'tick')} not {verb}: {details['cause']}"
    return ""


def _generator_text(values: list[float], unit: str) -> str:
    """Return the text of a generator, "" for an unknown one.

    `values` are the generator's kind and at least four parameters; `unit` follows each one that is a position, or in
    mode raw a drive.
    """
    kind, first, second, third, fourth, *_ = values
    match kind:
        case Generator.HOLD:
            return f"{first:.6g}{unit}"
        case Generator.SINE | Generator.TRIANGLE:
            offset_text = f" about {third:.6g}{unit}" if third else ""
            return f"{Generator(int(kind)).name.lower()} of {first:.6g}{unit} at {second:.6g} Hz{offset_text}"
        case Generator.CHIRP:
            return f"chirp of {first:.6g}{unit} from {second:.6g} to {third:.6g} Hz in {fourth:.6g} s"
        case Generator.TABLE:
            return f"{count_text(int(second), 'sample')}, {'repeated' if fourth else 'once'}"
        case Generator.INPUT:
            return "an input"
    return ""
