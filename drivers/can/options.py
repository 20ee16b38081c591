"""What a user may say about a CAN bus, and about the node on it. Needs neither python-can nor cantools."""

from __future__ import annotations

from typing import Any, Self

from pydantic import Field, model_validator

from rtloop.foundation.options import Options
from rtloop.hil.options import RigOptions


class BusOptions(Options):
    """A bus, as python-can opens it."""

    interface: str = "socketcan"
    """One of python-can's interfaces."""
    channel: str | int = "can0"
    bitrate: int = Field(default=1_000_000, ge=10_000, le=1_000_000)
    """bit/s; for CAN FD that of the arbitration phase."""
    fd: bool = False
    data_bitrate: int | None = Field(default=None, ge=10_000, le=20_000_000)
    """bit/s of CAN FD's data phase; `bitrate` by default, and then the rate of the bits is not switched."""
    settings: dict[str, str | int | float | bool] = Field(default_factory=dict)
    """More keywords for the interface, such as `hop_limit` of udp_multicast."""
    dbc: str | None = None
    """A description of the frames in place of rtloop.dbc."""

    @model_validator(mode="after")
    def _check_rates(self) -> Self:
        if self.data_bitrate is not None and not self.fd:
            raise ValueError(f"data_bitrate: {self.data_bitrate}; allowed with fd = true only")
        if self.data_bitrate is not None and self.data_bitrate < self.bitrate:
            raise ValueError(f"data_bitrate: {self.data_bitrate}; at least the bitrate, {self.bitrate}, is needed")
        return self

    @property
    def data_phase_bitrate(self) -> int:
        """bit/s between the arbitration phases."""
        return self.data_bitrate or self.bitrate

    @property
    def switches_bitrate(self) -> bool:
        """Whether the data phase is faster."""
        return self.data_phase_bitrate != self.bitrate

    @property
    def label(self) -> str:
        """The bus in a message."""
        return f"CAN bus {self.interface} {self.channel}"

    @property
    def keywords(self) -> dict[str, Any]:
        """What python-can is given."""
        rates: dict[str, Any] = {"bitrate": self.bitrate, "fd": self.fd}
        if self.fd:
            rates["data_bitrate"] = self.data_phase_bitrate
        return {"interface": self.interface, "channel": self.channel, **rates, **self.settings}


class CanOptions(BusOptions, RigOptions):
    """The node's bus, and how lost frames are answered; the rest describes the rig, for `rtloop hil serve --can`."""

    hold_ticks: int = Field(default=2, ge=0, le=10_000)
    """The last sample stands in for so many ticks in a row; then its age is infinite, which trips the loop."""
    wait_s: float = Field(default=10.0, gt=0, le=60.0)
    """How long `open` waits for the node."""
    watchdog_ms: float = Field(default=50.0, ge=1.0, le=65535.0)
    """Without a drive frame for so long the simulated node brings its outputs to 0 V."""
    park_slew_v_per_s: float = Field(default=1000.0, gt=0)
    """Ramp of the simulated node, there and back."""
