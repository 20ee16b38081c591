"""Options of a CAN bus and of the node on it. This module needs neither python-can nor cantools."""

from __future__ import annotations

from typing import Any, Self

from pydantic import Field, model_validator

from rtloop.foundation.options import Options
from rtloop.hil.options import RigOptions


class BusOptions(Options):
    """Options of a bus, for python-can."""

    interface: str = "socketcan"
    """Name of a python-can interface."""
    channel: str | int = "can0"
    """Channel of the interface, such as `can0`, or its number where the interface counts channels."""
    bitrate: int = Field(default=1_000_000, ge=10_000, le=1_000_000)
    """Bitrate in bit/s; with CAN FD, of the arbitration phase."""
    fd: bool = False
    """Send CAN FD frames; with false, classic CAN frames, of which each carries less."""
    data_bitrate: int | None = Field(default=None, ge=10_000, le=20_000_000)
    """Bitrate in bit/s of CAN FD's data phase; by default `bitrate`, without a rate switch."""
    settings: dict[str, str | int | float | bool] = Field(default_factory=dict)
    """Further keywords of the interface, such as `hop_limit` of udp_multicast."""
    dbc: str | None = None
    """Path of a description of the frames that replaces rtloop.dbc."""

    @model_validator(mode="after")
    def _check_rates(self) -> Self:
        """Raise ValueError for a `data_bitrate` without `fd`, and for one below `bitrate`."""
        if self.data_bitrate is not None and not self.fd:
            raise ValueError(
                f"data_bitrate: {self.data_bitrate} bit/s; allowed with fd = true only; set fd = true, or remove "
                "data_bitrate"
            )
        if self.data_bitrate is not None and self.data_bitrate < self.bitrate:
            raise ValueError(
                f"data_bitrate: {self.data_bitrate} bit/s; allowed: at least bitrate = {self.bitrate} bit/s"
            )
        return self

    @property
    def data_phase_bitrate(self) -> int:
        """Bitrate in bit/s of the data phase: `data_bitrate`, or `bitrate` if it is None."""
        return self.data_bitrate or self.bitrate

    @property
    def switches_bitrate(self) -> bool:
        """Whether the bitrates of data phase and arbitration phase differ."""
        return self.data_phase_bitrate != self.bitrate

    @property
    def label(self) -> str:
        """Text that names the bus in messages: interface and channel."""
        return f"CAN bus {self.interface} {self.channel}"

    @property
    def keywords(self) -> dict[str, Any]:
        """Keyword arguments of `can.Bus`: interface, channel, bitrate, fd, data_bitrate (CAN FD only), and the entries
        of `settings`, which replace others of the same name.
        """
        rates: dict[str, int] = {"bitrate": self.bitrate, "fd": self.fd}
        if self.fd:
            rates["data_bitrate"] = self.data_phase_bitrate
        return {"interface": self.interface, "channel": self.channel, **rates, **self.settings}


class CanOptions(BusOptions, RigOptions):
    """Options of the node's bus and of the simulated rig that `rtloop hil serve --can` runs as a node."""

    hold_ticks: int = Field(default=2, ge=0, le=10_000)
    """Largest number of successive ticks that use the last sample; then its age is infinite, which trips the loop."""
    wait_s: float = Field(default=10.0, gt=0, le=60.0)
    """Longest wait of `open` for the node's answer."""
    watchdog_ms: float = Field(default=50.0, ge=1.0, le=65535.0)
    """Time without a drive frame after which the simulated node ramps its outputs to 0 V."""
    park_slew_v_per_s: float = Field(default=1000.0, gt=0)
    """Slew rate of the simulated node's ramps to 0 V and back."""
