"""What an event is about, in words: its kind, its tick and who asked for it are shown beside them."""

from __future__ import annotations

from rtloop.law.reference import Generator
from rtloop.recording.file.topics.events import Event
from rtloop.values import counted


def words(event: Event) -> str:
    """Of an event as `event_of` makes it, of late ticks as `Lateness` does; empty where its kind says all there is."""
    what = event["what"]
    match event["kind"]:
        case "set_reference":
            return _reference([float(value or 0.0) for value in what["values"]])
        case "set_mode":
            return what["mode"].replace("_", " ")
        case "load_law":
            return "another controller" if what["values"][0] else "other numbers"
        case "tripped":
            return what["reason"] or ", ".join(what["causes"])
        case "periods_missed":
            return f"{counted(what['late_ticks'], 'late tick')}, worst {what['worst_ms']:.3g} ms"
    return ""


def _reference(values: list[float]) -> str:
    """Of a generator: its kind, then its parameters."""
    kind, first, second, third, fourth, *_ = values
    match kind:
        case Generator.HOLD:
            return f"{first:.6g}"
        case Generator.SINE | Generator.TRIANGLE:
            about = f" about {third:.6g}" if third else ""
            return f"{Generator(int(kind)).name.lower()} of {first:.6g} at {second:.6g} Hz{about}"
        case Generator.CHIRP:
            return f"chirp of {first:.6g} from {second:.6g} to {third:.6g} Hz in {fourth:.6g} s"
        case Generator.TABLE:
            return f"{counted(int(second), 'sample')}, {'again and again' if fourth else 'once'}"
        case Generator.INPUT:
            return "an input"
    return ""
