"""Options of a node and of the line to it. This module imports no network and no terminal."""

from __future__ import annotations

import os
from typing import Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from rtloop.drivers.node.frames import MAX_CHANNELS, MAX_DIGITAL
from rtloop.drivers.volt_ranges import Volts, require_ranges
from rtloop.hil.options import RigOptions

LONGEST_HOLD_TICKS = 1000
"""Fewer than the frames whose sending times are known."""


class NodeOptions(RigOptions):
    """Options of a node, whatever the line, and of the simulated rig that `rtloop hil serve` runs as a node."""

    answer: Literal["next tick", "same tick"] = "next tick"
    """Use of a sample. "next tick": the answer to the last drive; one frame per direction, the model has one more tick
    of delay. "same tick": each tick asks for a sample and waits for it, at most `deadline_us`; two frames to the node.
    """
    deadline_us: float = Field(default=60.0, gt=0, le=1e6)
    """Longest wait for the sample with answer = "same tick". After it, the tick uses the sample before, as held."""
    hold_ticks: int = Field(default=2, ge=0, le=LONGEST_HOLD_TICKS)
    """Largest number of successive ticks that use the last sample; then its age is infinite, which trips the loop."""
    error_limit: int = Field(default=10, ge=2, le=1_000_000)
    """Error level that ends the exchange. It rises by 2 in a tick without an answer in time, and falls by 1 else."""
    watchdog_ms: float = Field(default=50.0, ge=1.0, le=10_000.0)
    """Time without a drive after which the node ramps its outputs to their safe values and ends the session. A node
    that holds them for less time by its own choice keeps to its own."""
    wait_s: float = Field(default=10.0, gt=0, le=60.0)
    """Longest wait of `open` for the node's answer."""
    key: str | None = None
    """Path of the file with the key that loop and node share, 32 hexadecimal digits, which only you may read; relative
    to the configuration's folder. By default none: everybody who can send to the node may drive it."""
    inputs: int | None = Field(default=None, ge=1, le=MAX_CHANNELS - 1)
    """Number of the node's inputs, named adc0, adc1, …; by default as many as there are axes."""
    outputs: int | None = Field(default=None, ge=1, le=MAX_CHANNELS - 1)
    """Number of the node's outputs, named dac0, dac1, …; by default as many as there are axes."""
    digital_inputs: int = Field(default=0, ge=0, le=MAX_DIGITAL)
    """Number of the node's digital inputs, named di0, di1, …; they read 0 or 5 V."""
    digital_outputs: int = Field(default=0, ge=0, le=MAX_DIGITAL)
    """Number of the node's digital outputs, named do0, do1, …; from 2.5 V of 0 … 5 V on they are high."""
    input_range_v: Volts = (-10.0, 10.0)
    """Range of every input; a node with another range is refused when it is opened."""
    output_range_v: Volts = (-10.0, 10.0)
    """Range of every output; a node with another range is refused when it is opened."""
    safe_v: float = 0.0
    """Voltage to which the node parks every output; a node with another one is refused."""
    park_slew_v_per_s: float = Field(default=1000.0, gt=0, le=1e6)
    """Slew rate of the simulated node's ramps; a real node has its own."""

    @field_validator("key")
    @classmethod
    def _resolve_key(cls, key: str | None, info: ValidationInfo) -> str | None:
        """Return the path of the key's file, absolute if the context of the validation names the `folder`."""
        folder = (info.context or {}).get("folder")
        return key if key is None or folder is None else os.path.abspath(os.path.join(folder, key))

    @model_validator(mode="after")
    def _check_ranges(self) -> Self:
        """Raise ValueError for a range whose lower end is not before its higher, for `safe_v` outside `output_range_v`,
        and for more than MAX_CHANNELS inputs and outputs together, where a number that is None counts as 1.
        """
        require_ranges(self.input_range_v, self.output_range_v, self.safe_v)
        if (self.inputs or 1) + (self.outputs or 1) > MAX_CHANNELS:
            raise ValueError(
                f"inputs, outputs: {self.inputs} and {self.outputs}; allowed: at most {MAX_CHANNELS} in all"
            )
        return self

    @property
    def waits(self) -> bool:
        """Whether a tick asks for its own sample and waits for it; else it uses the answer to the last tick's drive."""
        return self.answer == "same tick"

    @property
    def label(self) -> str:
        """Text that names the node in messages; each subclass defines it."""
        raise NotImplementedError


class UdpOptions(NodeOptions):
    """Options of a node behind UDP."""

    host: str = "192.168.10.2"
    """Name or address of the node, IPv4 or IPv6."""
    port: int = Field(default=5747, ge=1, le=65535)
    """UDP port at which the node receives."""
    bind: str | None = None
    """Address of this computer's interface to the node; by default the system chooses it by its routes. The simulated
    node uses `host` and `port` alone."""

    @property
    def label(self) -> str:
        """Text that names the node in messages: host and port."""
        return f"UDP {self.host} port {self.port}"


class SerialOptions(NodeOptions):
    """Options of a node behind a serial line or USB."""

    device: str = "/dev/ttyACM0"
    """Path of the terminal. The simulated node makes a pseudo-terminal with a link here."""
    baud: int | None = Field(default=None, ge=1200, le=12_000_000)
    """Rate of a real serial line in bit/s, 8 data bits, no parity, 1 stop bit. By default none, for USB, which has its
    own rate."""

    @property
    def label(self) -> str:
        """Text that names the node in messages: the device."""
        return f"serial line {self.device}"
