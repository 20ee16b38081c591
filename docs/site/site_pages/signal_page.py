"""Page of all signals of a tick, with modes and flags, from their one definition."""

from __future__ import annotations

from collections.abc import Iterable

from rtloop import signals
from rtloop.configuration.field_texts import texts_below
from site_pages.texts import anchored, escape, table

INTRODUCTION = """# Signals

A recording has one row for each executed tick. Its columns are the common signals, the signals of each axis with the
axis's name in front (`x_position_um`), extra inputs and outputs in volts (`gate_v`), and the signals that the driver
observes. The unit 1 is a number without a unit.

    import rtloop
    run = rtloop.load("recordings/FILE.mcap")
    run["x_position_um"], run.time_s

"""


def _rows(rows: Iterable[signals.Signal], prefix: str = "") -> list[tuple[str, str, str]]:
    """Return the cells of signals."""
    return [(anchored(prefix + row.name, row.name), row.unit, escape(row.meaning)) for row in rows]


def signal_page() -> str:
    """Return the page of all signals."""
    head = ("signal", "unit", "meaning")
    modes, flags = texts_below(signals.Mode), texts_below(signals.Flag)
    plain = [flag for flag in signals.Flag if not flag & signals.TRIP_MASK]
    trips = [flag for flag in signals.Flag if flag & signals.TRIP_MASK]
    parts = [
        INTRODUCTION,
        "## Common signals\n", table(head, _rows(signals.COMMON_SIGNALS)),
        "## Signals of an axis\n\nFor an axis `x`:\n", table(head, _rows(signals.AXIS_SIGNALS, "x_")),
        "## Observed signals of the simulated rig\n\nThe rig's truth is recorded. The law never sees it.\n",
        table(head, [
            ("`x_true_position_um`", "µm", "position without the sensor's noise, offset, lag and resolution"),
            ("`x_hysteresis_um`", "µm", "output of the hysteresis, before the dynamics"),
        ]),
        "## Modes { #modes }\n\nValues of the signal `mode`. `[loop] mode` and `rtloop ctl mode` take the names.\n",
        table(("value", "mode", "meaning"),
              [(str(mode.value), anchored(mode.name.lower(), f"mode.{mode.name}"), escape(modes.get(mode.name, "")))
               for mode in signals.Mode]),
        "## Flags { #bits-of-flags }\n\nBits of the signal `flags`.\n",
        table(("bit", "flag", "meaning"),
              [(_bit(flag), anchored(str(flag.name), f"flag.{flag.name}"), escape(flags.get(str(flag.name), "")))
               for flag in plain]),
        "## Trip causes\n\nA trip cause stays set in `flags` until `rtloop ctl reset`. "
        "[`[axis.interlocks]`](configuration.md#axis.interlocks) has the conditions; [Safety](../safety.md) explains "
        "them.\n",
        table(("bit", "flag", "unit of its value"),
              [(_bit(flag), anchored(str(flag.name), f"flag.{flag.name}"), flag.unit.strip()) for flag in trips]),
    ]  # fmt: skip
    return "\n".join(parts)


def _bit(flag: signals.Flag) -> str:
    """Return the number of a flag's bit, from 0."""
    return str(int(flag).bit_length() - 1)
