"""What an event is about, in words: its kind, its tick and who asked for it are shown beside them."""

from __future__ import annotations

from typing import Any

from rtloop.kernel.reference import Generator
from rtloop.recording.file.topics.events import Event
from rtloop.values import count_text

OFF, RAW = "off", "raw"
"""Modes, in words. A service whose configuration has no schedule begins with the outputs off."""


class RunState:
    """References and mode of a run, as its events so far leave them: an event is told with its before and after."""

    def __init__(self, axes: dict[str, dict[str, Any]], mode: str | None = None) -> None:
        """`axes` are the configured ones, by name: their references play until events name others. `mode` is that of
        the first tick, in words; None where it is not known.
        """
        self._references = {name: reference_text(axis.get("reference") or {}) for name, axis in axes.items()}
        self._mode = mode

    def describe_change(self, event: Event) -> str:
        """Words of the run's next event: `0 → 12.5 µm`, `closed loop → off`; those of `words` for other kinds."""
        kind, text = event["kind"], event_text(event)
        if kind == "set_reference":
            return self._change_reference(event["axis"], text)
        if kind == "set_mode":
            previous_mode, self._mode = self._mode, text
            if RAW in (previous_mode, text):
                self._references.clear()  # the loop holds what was in force, which no event says
            return f"{previous_mode} → {text}" if previous_mode not in (None, text) else text
        if kind == "tripped":
            self._mode = OFF
        return text

    def _change_reference(self, axis: str, text: str) -> str:
        """The reference before, as far as it is known, and the one that takes over."""
        previous_reference, self._references[axis] = self._references.get(axis), text
        unit = "V" if self._mode == RAW else "µm"
        return f"{previous_reference} → {text} {unit}" if previous_reference else f"{text} {unit}"


def reference_text(reference: dict[str, Any]) -> str:
    """Words of a reference as a configuration has it; empty for one of many samples or levels."""
    match reference.get("kind", "hold"):
        case "hold":
            return _generator_text([Generator.HOLD, float(reference.get("value", 0.0)), *[0.0] * 4])
        case "sine" | "triangle" as kind:
            values = [float(reference.get(key, 0.0)) for key in ("amplitude", "frequency_hz", "offset")]
            return _generator_text([Generator[kind.upper()], *values, 0.0, 0.0])
    return ""


def event_text(event: Event) -> str:
    """Of an event as `event_from_message` makes it, of late ticks as `LateEpisodes` does; empty where its kind says
    it all."""
    details = event["what"]
    match event["kind"]:
        case "set_reference":
            return _generator_text([float(value or 0.0) for value in details["values"]])
        case "set_mode":
            return details["mode"].replace("_", " ")
        case "load_law":
            return details.get("change") or ("another controller" if details["values"][0] else "other numbers")
        case "tripped":
            return details["reason"] or ", ".join(details["causes"])
        case "periods_missed":
            return f"{count_text(details['late_ticks'], 'late tick')}, worst {details['worst_ms']:.3g} ms"
    return ""


def _generator_text(values: list[float]) -> str:
    """Of a generator: its kind, then its parameters."""
    kind, first, second, third, fourth, *_ = values
    match kind:
        case Generator.HOLD:
            return f"{first:.6g}"
        case Generator.SINE | Generator.TRIANGLE:
            offset_text = f" about {third:.6g}" if third else ""
            return f"{Generator(int(kind)).name.lower()} of {first:.6g} at {second:.6g} Hz{offset_text}"
        case Generator.CHIRP:
            return f"chirp of {first:.6g} from {second:.6g} to {third:.6g} Hz in {fourth:.6g} s"
        case Generator.TABLE:
            return f"{count_text(int(second), 'sample')}, {'again and again' if fourth else 'once'}"
        case Generator.INPUT:
            return "an input"
    return ""
