"""Options of the service: [service] and its tables."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rtloop.drivers.can.options import BusOptions
from rtloop.foundation.options import Options


class DepolariseOptions(Options):
    """A sine of falling amplitude before the first command, which wipes out the actuator's memory."""

    amplitude_v: float = Field(gt=0)
    """Amplitude of the sine at its beginning; it falls to 0 in a straight line. Limits of the drive apply."""
    frequency_hz: float = Field(default=10.0, gt=0)
    """Frequency of the sine that erases the memory."""
    cycles: int = Field(default=20, ge=2, le=1000)
    """Number of cycles until the amplitude is 0."""


Cause = Literal["stale", "driver", "late", "heartbeat"]
"""Causes of a trip that lie outside the loop: link, hardware, host, supervisor."""


class RecoverOptions(Options):
    """Return to the former mode after a trip whose cause lies outside the loop, once the readings are sound again."""

    causes: Annotated[tuple[Cause, ...], Field(strict=False, min_length=1)] = ("stale", "driver", "late")
    """Causes of a trip after which the service returns; a trip with any other cause stays latched."""
    wait_s: float = Field(default=1.0, ge=0.1, le=60.0)
    """Time from the trip to the first confirmation, and between two starts of a loop whose driver fails."""
    confirmations: int = Field(default=5, ge=1, le=1000)
    """Number of successive confirmations before the return; an unsound reading begins them anew."""
    confirmation_s: float = Field(default=0.2, ge=0.01, le=5.0)
    """Duration of a confirmation: the readings of all its ticks must be sound."""
    max_per_hour: int = Field(default=3, ge=1, le=60)
    """Largest number of recoveries in any hour; the next trip stays latched."""
    depolarise: bool = False
    """Erase the actuator's memory before the return, with the sine of [service.depolarise]."""


class ServiceOptions(Options):
    """Options of `rtloop serve`."""

    socket: str | None = None
    """Path of the control socket; RUNTIME_DIRECTORY/NAME.sock, or /run/user or /tmp, by default."""
    socket_mode: Annotated[str, Field(pattern=r"^0[0-7]{3}$")] = "0660"
    """Permissions of the control socket as an octal number; a mode with access for others is refused."""
    emergency_key_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    """Hash, as sha256sum prints it, of the key that takes the lock from its holder; recordings contain this text."""
    stall_ms: float = Field(default=50.0, ge=10.0)
    """Ticks that stand still for so long, while the supervisor was awake, get the loop killed and parked."""
    arm: bool = False
    """Start with the outputs off, and drive only after `arm` and `start`."""
    restarts: int = Field(default=3, ge=0)
    """Number of restarts in `restart_window_s` of a loop that died, outputs off."""
    restart_window_s: float = Field(default=60.0, gt=0)
    """Time in which deaths of the loop count; after more than `restarts` of them the service ends."""
    tare_s: float = Field(default=0.0, ge=0, le=60.0)
    """Duration whose mean reading, outputs at safe, becomes position 0."""
    depolarise: DepolariseOptions | None = None
    """Sine that erases the actuator's memory at the start; not allowed with a schedule, and not played with `arm`."""
    recover: RecoverOptions | None = None
    """Return after a trip from outside, such as a lost link; without this table a trip stays latched until `reset`."""
    can: BusOptions | None = None
    """A CAN bus on which the service reports its state and receives setpoints and modes."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Require a socket_mode without access for others, and a sine for a recovery that depolarises."""
        if int(self.socket_mode, 8) & 0o007:
            raise ValueError(
                f"socket_mode: {self.socket_mode}; allowed: a mode without access for others, such as 0660"
            )
        if self.recover is not None and self.recover.depolarise and self.depolarise is None:
            raise ValueError(
                "recover.depolarise: true; add the table [service.depolarise], whose sine the recovery plays"
            )
        return self

    @property
    def prepares(self) -> bool:
        """Whether `depolarise` is set or `tare_s` is above 0: a start without `arm` then prepares the actuator."""
        return self.depolarise is not None or self.tare_s > 0

    def faults_with_schedule(self) -> list[str]:
        """Return a sentence for each reason why `rtloop serve` refuses these options together with a [[schedule]]."""
        faults = []
        if self.prepares:
            faults.append(
                "schedule: not allowed with service.tare_s or service.depolarise, because they use the first ticks"
            )
        if self.recover is not None:
            faults.append(
                "schedule: not allowed with service.recover, because a loop that recovers from a trip does not repeat "
                "its schedule"
            )
        return faults
