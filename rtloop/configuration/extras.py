"""[inputs] and [outputs]: channels beside the sensors and the drives, which controllers read and set by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, Self

from pydantic import model_validator

from rtloop import signals
from rtloop.configuration.axis import AxisOptions
from rtloop.drivers.base import Channel, Facts, Wiring, channel_index
from rtloop.foundation.options import Options
from rtloop.kernel.extras import ExtraOutput, Extras, Mark
from rtloop.kernel.layout import MAX_EXTRAS
from rtloop.laws.contract import Law

NAME = r"^[a-z][a-z0-9_]{0,31}$"


class ExtraInputOptions(Options):
    """A channel that is read each tick."""

    channel: str
    """Name of one of the driver's input channels, such as `adc1`."""


class ExtraOutputOptions(Options):
    """A channel set by the controller of an axis, or by the axis itself as a mark; else it has its safe voltage."""

    channel: str
    """Name of one of the driver's output channels that neither an axis nor another output uses, such as `dac1`."""
    axis: str
    """Name of the axis whose controller sets the channel, or whose reference or position the mark follows."""
    mark: Literal["rising", "moving", "position"] | None = None
    """Condition under which the channel has `max_v`: the reference rises, the reference changes, or the position is at
    `level_um` or above it. By default the controller sets the channel."""
    level_um: float | None = None
    """Position in µm from which on a channel with mark = "position" is high; no other mark takes it."""
    min_v: float | None = None
    """Lowest voltage that the controller can set, by default the channel's lowest."""
    max_v: float | None = None
    """Highest voltage that the controller can set, and the voltage of a mark; by default the channel's highest. The
    channel's safe voltage must lie between `min_v` and `max_v`, as parking sets it under any configuration."""

    @model_validator(mode="after")
    def _check_level(self) -> Self:
        """Require `level_um` with mark = "position", and refuse it otherwise."""
        if (self.mark == "position") != (self.level_um is not None):
            value = "missing" if self.level_um is None else f"{self.level_um:g} µm"
            raise ValueError(
                f"level_um: {value}; allowed: a number if mark = 'position'; with any other mark, remove level_um"
            )
        return self


def extra_faults(
    inputs: Mapping[str, ExtraInputOptions],
    outputs: Mapping[str, ExtraOutputOptions],
    hold_input: str | None,
    axes: Sequence[AxisOptions],
) -> list[str]:
    """Return a line for each fault of [inputs], [outputs] and `loop.hold_input`: more than MAX_EXTRAS channels, an
    output with the name of an input, an unknown axis, an unknown input.
    """
    faults: list[str] = []
    for section, channels in (("inputs", inputs), ("outputs", outputs)):
        if len(channels) > MAX_EXTRAS:
            faults.append(f"{section}: {len(channels)} channels; allowed: up to {MAX_EXTRAS}")
    faults += [f"outputs.{name}: an input has the same name; rename one of them" for name in outputs if name in inputs]
    names = [axis.name for axis in axes]
    for name, output in outputs.items():
        if output.axis not in names:
            faults.append(f"outputs.{name}.axis: {output.axis!r} is not an axis; the axes are {', '.join(names)}")
    if hold_input is not None and hold_input not in inputs:
        available_text = f"allowed: {', '.join(inputs)}" if inputs else "[inputs] has no entry"
        faults.append(f"loop.hold_input: {hold_input!r} is not among [inputs]; {available_text}")
    return faults


def build_extras(
    inputs: Mapping[str, ExtraInputOptions],
    outputs: Mapping[str, ExtraOutputOptions],
    axes: Sequence[str],
    facts: Facts,
    wiring: Mapping[str, Wiring],
) -> Extras:
    """Return the names of the extra inputs, and the extra outputs with their ranges, by default the channels' ranges.

    Raises ValueError for a channel that does not exist, an output's channel that an axis or another output uses, a name
    that is a column already, and a range that exceeds the channel's or excludes the channel's safe voltage.
    """
    for name, input_options in inputs.items():
        _require_channel(f"inputs.{name}.channel", facts.inputs, input_options.channel)
    columns = signals.column_names(axes, facts.observed)
    for name in (*inputs, *outputs):
        if f"{name}_v" in columns:
            section = "inputs" if name in inputs else "outputs"
            raise ValueError(
                f"{section}.{name}: its column {name}_v would have the name of a signal that rtloop records itself; "
                "use another name"
            )
    channel_users = {axis_wiring.output: f"the drive of axis {axis}" for axis, axis_wiring in wiring.items()}
    extra_outputs = []
    for name, options in outputs.items():
        channel = facts.outputs[_require_channel(f"outputs.{name}.channel", facts.outputs, options.channel)]
        if channel.name in channel_users:
            raise ValueError(f"outputs.{name}.channel: {channel.name!r} is used by {channel_users[channel.name]}")
        channel_users[channel.name] = f"output {name}"
        lowest_v = channel.minimum_v if options.min_v is None else options.min_v
        highest_v = channel.maximum_v if options.max_v is None else options.max_v
        safe_v = channel.safe_v
        if not channel.minimum_v <= lowest_v <= safe_v <= highest_v <= channel.maximum_v:
            raise ValueError(
                f"outputs.{name}: {lowest_v:g} … {highest_v:g} V; allowed: a range within the channel's "
                f"{channel.minimum_v:g} … {channel.maximum_v:g} V that includes its safe voltage, {safe_v:g} V"
            )
        mark = Mark[options.mark.upper()] if options.mark else Mark.NONE
        number = list(axes).index(options.axis)
        extra_outputs.append(ExtraOutput(name, number, lowest_v, highest_v, safe_v, int(mark), options.level_um or 0.0))
    return Extras(tuple(inputs), tuple(extra_outputs))


def _require_channel(key: str, channels: Sequence[Channel], name: str) -> int:
    """Return the index of the channel `name`. Raises ValueError, with its `key`, if the driver lacks it."""
    try:
        return channel_index(channels, name)
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from None


def connect(law: Law, owned: Sequence[str], inputs: Sequence[str], outputs: Mapping[str, ExtraOutputOptions]) -> None:
    """Set `law.channels`: by name, the number of each input of the law in `inputs`, and of each output in `outputs`.

    `inputs` and `outputs` are all of the configuration, numbered in their order from 0; `owned` are the names of the
    law's axes. Raises ValueError for a channel that the law names and the configuration lacks, and for an output of
    another axis or with a mark.
    """
    numbers = {name: number for number, name in enumerate(inputs)}
    numbers |= {name: number for number, name in enumerate(outputs)}
    axis_outputs = [name for name, output in outputs.items() if output.axis in owned and output.mark is None]
    for kind, names, available in (("input", law.inputs, list(inputs)), ("output", law.outputs, axis_outputs)):
        for name in names:
            if name not in available:
                available_text = ", ".join(available) or "none"
                raise ValueError(
                    f"law {law.kind!r} needs the {kind} {name!r} in [{kind}s]; available for this law: {available_text}"
                )
    law.channels = {name: numbers[name] for name in (*law.inputs, *law.outputs)}
