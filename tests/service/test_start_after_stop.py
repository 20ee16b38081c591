"""Stops and starts at every command of a recovery or a preparation, in virtual time: a start drives or says why not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtloop.errors import RtloopError
from rtloop.service.desk import Refusal, UnconfirmedCommand
from rtloop.service.service import State
from tests.virtual.service import FEEDFORWARD, RAW, RECOVER, VirtualService

PERIOD_S, RETURN_COMMANDS = 0.04, 18
SINE_V = [[2.0, 5.0], [4.0, 7.0]]
"""Extremes of the drives of x and y for the configured references, 12 µm ± 4 µm with 4 µm/V, and 12 µm ± 2 µm with
2 µm/V."""
STEEPEST_V = 1.0
"""Bound on the change of a drive in a tick of a return: a reference that begins without its ramp changes it by more."""
DEPOLARISE = "\n[service.depolarise]\namplitude_v = 1.0\nfrequency_hz = 50.0\ncycles = 4\n"
VARIANTS = {
    "feedforward": (FEEDFORWARD, RECOVER),
    "raw, depolarised": (RAW, RECOVER + "depolarise = true\n" + DEPOLARISE),
}


Make = Callable[..., VirtualService]


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """Yield the constructor of a service; its threads end with the test."""
    services: list[VirtualService] = []

    def construct(base: str = FEEDFORWARD, more: str = RECOVER) -> VirtualService:
        services.append(VirtualService(tmp_path, monkeypatch, more, base))
        return services[-1]

    yield construct
    for service in services:
        service.turns.end()


def assert_drives(service: VirtualService) -> None:
    """Assert that the drive follows the configured sine."""
    service.turns.sleep(0.3)
    drive_v = service.drive_v(2 * PERIOD_S)
    np.testing.assert_allclose([drive_v.min(axis=0), drive_v.max(axis=0)], SINE_V, atol=0.05)


def refusal(request: Any) -> str:
    """Send a request; return the reason of its refusal, "" if it is accepted."""
    try:
        request()
    except RtloopError as error:
        return str(error)
    return ""


@pytest.fixture(params=VARIANTS)
def returning(request: pytest.FixtureRequest, make: Make) -> VirtualService:
    """Return a service at the begin of the return after a trip, before its first command."""
    service = make(*VARIANTS[request.param])
    service.begin_loop()
    service.service.start()
    assert_drives(service)
    service.start_recovery()
    service.trip()
    service.wait_for(lambda: service.recovery_state == "returning")
    service.commands_sent = 0
    return service


@pytest.mark.parametrize("commands", range(1, RETURN_COMMANDS))
def test_a_start_after_a_stop_in_a_return_drives_the_former_reference(returning: VirtualService, commands: int):
    returning.wait_for(lambda: returning.commands_sent >= commands or returning.recovery_state == "ready")
    returning.service.stop()
    assert not returning.drive_v(0.4)[-20:].any()
    if reason := refusal(returning.service.start):
        assert "use reset first" in reason
        returning.service.reset()
        returning.service.start()
    assert_drives(returning)
    assert returning.recovery_state == "ready"


@pytest.mark.parametrize("commands", [1, 2, 4, 7, 11])
def test_a_start_in_a_return_is_refused_with_a_reason_and_the_return_goes_on(returning: VirtualService, commands: int):
    """No drive jumps in the return."""
    before = len(returning.driver.written)
    returning.wait_for(lambda: returning.commands_sent >= commands or returning.recovery_state == "ready")
    reason = refusal(returning.service.start)
    assert ("use reset first" in reason or "returning to its mode before the trip" in reason) == bool(reason)
    returning.wait_for(lambda: returning.recovery_state == "ready")
    assert_drives(returning)
    assert np.abs(np.diff(returning.driver.written[before:], axis=0)).max() < STEEPEST_V


@pytest.mark.parametrize("commands", [0, 1, 2, 4, 7, 11])
def test_a_loop_that_ends_in_a_return_is_returned_to_again(returning: VirtualService, commands: int):
    """The driver fails, and the next loop begins with its outputs off."""
    returning.wait_for(lambda: returning.commands_sent >= commands or returning.recovery_state == "ready")
    if returning.recovery_state == "ready":
        return
    service, fault = returning.service, "the card does not answer"
    returning.end_loop()
    assert service.recovery.accept_end("driver_failed", fault)
    service.faults.append(fault)
    returning.turns.sleep(0.3)
    assert "no loop is running" in refusal(service.reset)
    returning.begin_loop()
    returning.wait_for(lambda: returning.recovery_state == "ready")
    assert service.faults == []
    assert_drives(returning)


@pytest.mark.parametrize("commands", [0, 1, 4])
def test_a_stop_without_a_loop_says_that_it_holds_and_it_does(returning: VirtualService, commands: int):
    returning.wait_for(lambda: returning.commands_sent >= commands)
    service, fault = returning.service, "the card does not answer"
    returning.end_loop()
    service.recovery.accept_end("driver_failed", fault)
    service.faults.append(fault)
    with pytest.raises(Refusal, match=r"no loop is running: .* tripped; the stop stays in force: the next loop"):
        service.stop()
    returning.begin_loop()
    assert not returning.drive_v(0.5).any()
    assert (service.state, returning.recovery_state in ("latched", "ready")) == (State.TRIPPED, True)
    assert "use reset first" in refusal(service.start)
    service.reset()
    service.start()
    assert_drives(returning)


@pytest.fixture(params=VARIANTS)
def preparing(request: pytest.FixtureRequest, make: Make) -> VirtualService:
    """Return a service whose first loop has begun, with its outputs off, and is to be prepared."""
    service = make(*VARIANTS[request.param])
    service.begin_loop()
    return service


@pytest.mark.parametrize("commands", range(9))
def test_a_stop_in_the_preparation_of_a_loop_holds_until_a_start_that_drives(preparing: VirtualService, commands: int):
    service = preparing.service
    if commands == 0:
        service.stop()
    preparing.commands_sent = 0
    thread = preparing.turns.start(service._prepare_and_start)
    if commands:
        preparing.wait_for(lambda: preparing.commands_sent >= commands or not thread.is_alive())
        service.stop()
    drive_v = preparing.drive_v(0.5)
    assert (drive_v[-200:].any(), service.faults) == (False, [])
    assert commands or not drive_v.any()
    service.start()
    assert_drives(preparing)


def test_a_start_that_no_loop_heard_has_no_later_effect(make: Make):
    """The loop of a service that begins in mode off is asked to close before its first tick."""
    preparing = make(FEEDFORWARD.replace('"feedforward"', '"off"'), "")
    with pytest.raises(Refusal, match="no loop is running: the state of the service is starting; try again"):
        preparing.service.set_mode("feedforward")
    preparing.begin_loop()
    preparing.turns.start(preparing.service._prepare_and_start)
    assert not preparing.drive_v(0.3).any()


HANGS = {
    "start": (lambda s: s.start(), Refusal, "the command is withdrawn"),
    "mode": (lambda s: s.set_mode("raw"), Refusal, "the command is withdrawn"),
    "setpoint": (lambda s: s.live.references.set("x", {"kind": "hold", "value": 1.0}), Refusal, "is withdrawn"),
    "stop": (lambda s: s.stop(), UnconfirmedCommand, "mode off stays in force: the outputs ramp to safe as soon as"),
}


@pytest.mark.parametrize("request_name", HANGS)
def test_a_request_of_which_a_hanging_loop_takes_no_notice_is_withdrawn_unless_it_makes_safe(
    make: Make, request_name: str
):
    request, kind, words = HANGS[request_name]
    hanging = make()
    hanging.begin_loop()
    hanging.service.start()
    hanging.turns.sleep(0.1)
    hanging.hangs = True
    with pytest.raises(RtloopError, match=words) as caught:
        request(hanging.service)
    assert type(caught.value) is kind
    hanging.hangs = False
    if request_name == "stop":
        assert not hanging.drive_v(0.2)[-100:].any()
        hanging.service.start()
    assert_drives(hanging)


def test_a_stop_of_a_loop_that_is_killed_meanwhile_says_so(make: Make, monkeypatch: pytest.MonkeyPatch):
    hanging = make()
    hanging.begin_loop()
    hanging.hangs = True
    monkeypatch.setattr(
        hanging.service.supervisor, "error", "the loop's process stood still and was killed", raising=False
    )
    with pytest.raises(
        Refusal, match="mode off: the loop's process stood still and was killed; the stop stays in force"
    ):
        hanging.service.stop()


def test_a_reset_that_is_withdrawn_says_that_the_recovery_has_ended(make: Make):
    hanging = make()
    hanging.begin_loop()
    hanging.service.start()
    hanging.trip()
    hanging.hangs = True
    with pytest.raises(Refusal, match=r"the command is withdrawn; .*; the recovery that was under way has ended$"):
        hanging.service.reset()
    hanging.hangs = False
    hanging.turns.sleep(0.1)
    assert hanging.service.state is State.TRIPPED
