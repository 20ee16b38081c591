"""Parking: bring outputs to their safe values without the loop, ramping from where they are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rtloop.drivers.base import Driver
from rtloop.drivers.errors import DriverError
from rtloop.engine.memory import UNREADABLE, SharedBlock, Word, claimant_pid
from rtloop.engine.ramp import (
    LONGEST_RAMP_S,
    output_indices,
    ramp_to_safe,
    safe_outputs_v,
    starting_outputs_v,
    unusable_drives,
)
from rtloop.errors import RtloopError, UnavailableError, one_line_error
from rtloop.foundation import timing
from rtloop.foundation.native.uncompiled import allow_uncompiled
from rtloop.foundation.trusted import close_descriptor
from rtloop.supervision.hardware import Hardware, UnusableNote, configured_hardware, read_note
from rtloop.supervision.parking_account import ParkingAccount
from rtloop.supervision.paths import block_path, hardware_path, open_block

RIG_OF_A_LOOP = "sim"
"""The driver whose hardware is in the loop's process."""
POLL_S = 0.005
KILL_S = 5.0
MARGIN_S = 2.0
"""Added to the time in which a loop without supervisor parks itself; after that the loop is killed."""


def park_configuration(config: Path, name: str | None = None) -> str:
    """Park the outputs of a configuration in place of a service that died. Returns a message about the result.

    `name` is the service's name. None means the service that drove these outputs last, whatever its name; if none is
    known, the one named like the stem of `config`.

    A loop that outlived its service gets the time to ramp down, and is killed after that. The hardware is that of the
    last run; if the configuration names another board, that board is parked as well. A failure of one board does not
    keep the other from being parked.

    Raises with nothing parked: UnavailableError while the service is alive or if its shared block cannot be used,
    HostRefusal for a block that another user may have written, and, if the hardware is unknown, the ConfigError,
    InputFileError or DriverError of the configuration. Raises DriverError or HostRefusal after all boards were tried.
    Several failures, or one failure besides parked outputs or remarks, become one RtloopError with all texts.
    """
    account = ParkingAccount(name or config.stem)
    boards = _find_boards(config, account.name, account)
    if name is None and boards:
        account.name = _service_of_newest_note(account.name, boards)
    name = account.name
    if boards:
        with _open_last_block(block_path(name), account) as block, account.collect_failures():
            if block is not None:
                driver = boards[0].driver()
                safe_v = safe_outputs_v(driver)[output_indices(driver)]
                with _block_errors(block_path(name)):
                    _await_end(block, boards[0].heartbeat_timeout_s, boards[0].trip_slew_v_per_s, safe_v)
            _park(boards[0], None if block is None else block["last_drive_v"], account)
        for board in boards[1:]:
            with account.collect_failures():
                _park(board, None, account)
    return account.result()


def _find_boards(config: Path, name: str, account: ParkingAccount) -> list[Hardware]:
    """Return the hardware that service `name` drove last, then the configuration's if it drives other outputs.

    Returns [] if neither is known. The account receives failures and remarks about an unusable note or configuration.
    """
    note: Hardware | None = None
    with account.collect_failures():
        try:
            note = read_note(hardware_path(name))
        except UnusableNote as error:
            account.remarks.append(str(error))
    try:
        configured = configured_hardware(config)
    except (RtloopError, DriverError) as error:
        if note is None:
            account.failures.append(error)
            return []
        account.remarks.append(
            f"parking uses the board of the last run, because the configuration cannot be used:\n{error}"
        )
        return [note]
    return [configured] if note is None else [note] if configured.drives_same_outputs(note) else [note, configured]


def _service_of_newest_note(name: str, boards: Sequence[Hardware]) -> str:
    """Return the name of the service that last drove the outputs of any of `boards`.

    It is known by the newest note of the hardware (a file NAME.hardware in the runtime folder) with the same driver and
    wiring. Returns `name` if there is no such note.
    """
    own_note, notes = hardware_path(name), list[Path]()
    with suppress(OSError):  # A folder that cannot be read keeps no output from being parked.
        notes = sorted(own_note.parent.glob(f"*{own_note.suffix}"), key=_modified_s, reverse=True)
    for note in notes:
        with suppress(RtloopError):  # A note that cannot be used says nothing.
            noted = read_note(note)
            if noted and any(noted.drives_same_outputs(board) for board in boards):
                return note.stem
    return name


def _modified_s(path: Path) -> float:
    """Return the time at which a file was last written, in s since 1970; 0 if the system does not tell."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def _park(hardware: Hardware, noted_v: npt.NDArray[np.float64] | None, account: ParkingAccount) -> None:
    """Park a board; the account receives the voltages that its outputs had, and remarks about unusable `noted_v`.

    `noted_v` (axes,) are the drives in the shared block; ignored if their number is not the board's number of axes.
    Raises ValueError for hardware that cannot be created, DriverError.
    """
    driver = hardware.driver()
    if noted_v is not None and len(noted_v) != len(driver.wiring):
        noted_v = None
    if noted_v is not None:
        account.remarks += unusable_drives(driver, noted_v)
    account.from_v += park(driver, hardware.trip_slew_v_per_s, noted_v)
    if hardware.driver_kind == RIG_OF_A_LOOP:
        account.remarks.append("driver 'sim': the simulated rig ended with its loop, so there was no output to park")


@contextmanager
def _open_last_block(path: Path, account: ParkingAccount) -> Iterator[SharedBlock | None]:
    """Open the shared block of a service for the work within; None if there is none that this version can read.

    An unreadable block adds a remark to the account. Raises UnavailableError if the block cannot be opened, or is
    unreadable while a process drives the outputs; HostRefusal for a file that another user may have written.
    """
    fd = open_block(path)
    if fd is None:
        yield None
        return
    try:
        block = None
        try:
            with _block_errors(path):
                found = SharedBlock.attach(fd, lambda: True)
            _require_known_arrays(found)
            block = found
        except EOFError:  # The service died before it had written the block.
            pass
        except UNREADABLE as error:
            if (pid := claimant_pid(fd)) is not None:
                raise UnavailableError(
                    f"process {pid} drives the outputs; stop that process, then use `rtloop park` again"
                ) from None
            account.remarks.append(
                f"{path}: the drive voltages that the loop wrote last cannot be read from this file and are ignored: "
                f"{one_line_error(error)}"
            )
        yield block
    finally:
        close_descriptor(fd)


def _require_known_arrays(block: SharedBlock) -> None:
    """Raise ValueError or KeyError unless the block has its control words and last drive voltages as this version does.

    Checked are the types and numbers of dimensions of both arrays, and that no control word is missing.
    """
    words, drives_v = block["words"], block["last_drive_v"]
    if words.dtype != np.uint64 or words.ndim != 1 or words.size < len(Word):
        raise ValueError(
            f"the array words has the type {words.dtype} and the shape {words.shape}; allowed: uint64, one dimension, "
            f"at least {len(Word)} values"
        )
    if drives_v.dtype != np.float64 or drives_v.ndim != 1:
        raise ValueError(
            f"the array last_drive_v has the type {drives_v.dtype} and the shape {drives_v.shape}; allowed: float64, "
            "one dimension, one value for each axis"
        )


@contextmanager
def _block_errors(path: Path) -> Iterator[None]:
    """Raise UnavailableError in place of an OSError of the shared block at `path`."""
    try:
        yield
    except OSError as error:
        raise UnavailableError(f"{path}: {error.strerror or error}") from None


def _await_end(
    block: SharedBlock, heartbeat_timeout_s: float, slew_v_per_s: float, safe_v: npt.NDArray[np.float64]
) -> None:
    """Wait until no process drives the outputs; kill one that has not ended after heartbeat timeout, ramp and MARGIN_S.

    The ramp leads from the drives in the block to `safe_v` (axes,), V. Raises UnavailableError while the service is
    alive: its heartbeat changes. Raises DriverError for a process that cannot be killed.
    """
    ramp_s, drives_v = LONGEST_RAMP_S, block["last_drive_v"]
    if drives_v.shape == safe_v.shape:
        ramp_s = float(np.max(np.abs(drives_v - safe_v))) / slew_v_per_s
        ramp_s = ramp_s if ramp_s <= LONGEST_RAMP_S else LONGEST_RAMP_S  # Also for a drive that is NaN.
    beat_ns = block.load(Word.HEARTBEAT_NS)
    kill_time_s = timing.monotonic_s() + heartbeat_timeout_s + ramp_s + MARGIN_S
    while (pid := block.driver_pid()) is not None:
        if block.load(Word.HEARTBEAT_NS) != beat_ns:
            raise UnavailableError(f"process {pid} drives the outputs and its service is alive; use `rtloop ctl stop`")
        if timing.monotonic_s() > kill_time_s + KILL_S:
            raise DriverError(
                f"process {pid} drives the outputs and cannot be killed; the outputs may still carry voltage; check "
                "the amplifier"
            )
        if timing.monotonic_s() > kill_time_s:
            block.kill_driver()
        timing.sleep(POLL_S)


def park(driver: Driver, slew_v_per_s: float, noted_v: npt.NDArray[np.float64] | None = None) -> list[float]:
    """Open the driver, ramp every output to its safe value, close it. Returns the volts of all outputs before the ramp.

    `noted_v` (axes,) are the last known drives; they are used if the card cannot read its outputs back, and are updated
    during the ramp. Outputs that are safe do not move. Uncompiled code runs where compiled code is not ready. Raises
    DriverError in place of any exception of the driver.
    """
    try:
        with allow_uncompiled():
            return _ramp_down(driver, slew_v_per_s, noted_v)
    except DriverError:
        raise
    except Exception as error:
        raise DriverError(
            f"driver {driver.kind!r}: the outputs could not be set to their safe values "
            f"({one_line_error(error)}); the outputs may still carry voltage; check the amplifier"
        ) from error


def _ramp_down(driver: Driver, slew_v_per_s: float, noted_v: npt.NDArray[np.float64] | None) -> list[float]:
    """Do the work of `park`; raises the driver's own exceptions. A driver that was opened is closed in any case."""
    pointers = driver.open()
    try:
        from_v, index = starting_outputs_v(driver, noted_v), output_indices(driver)

        def record_drives(outputs_v: npt.NDArray[np.float64]) -> None:
            """Store the drives of the axes from all outputs' voltages in `noted_v`, if there is one."""
            if noted_v is not None:
                noted_v[:] = outputs_v[index]

        ramp_to_safe(driver, pointers, from_v, slew_v_per_s, record_drives)
        record_drives(safe_outputs_v(driver))
        return from_v.tolist()
    finally:
        driver.close()
