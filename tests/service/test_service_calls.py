"""A service whose host refuses a system call that the loop does not need: the loop continues, and the service ends."""

from __future__ import annotations

import errno
import os
import socket
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from rtloop.engine.commands import QueueFull
from rtloop.engine.memory import SharedBlock, Sizes
from rtloop.engine.messages import Kind
from rtloop.errors import UnavailableError
from rtloop.service import daemon
from rtloop.service.desk import Refusal, RefusedByLoop
from rtloop.service.notify import Notifier
from rtloop.service.service import Service
from rtloop.signals import FLAGS, MODE, Flag
from rtloop.supervision.child import Child
from tests.service.test_run import PAPER


def refuse(*_: object, **__: object) -> Any:
    """Raise the error of a process that has too many open files."""
    raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))


def test_a_manager_that_cannot_be_told_stops_no_loop(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("NOTIFY_SOCKET", "/nowhere")
    notifier = Notifier()
    monkeypatch.setattr(socket, "socket", refuse)
    notifier.send(READY=1)


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left"), RuntimeError("can't start new thread")])
def test_what_the_host_refuses_is_said_in_a_sentence(error: Exception):
    with pytest.raises(UnavailableError, match="the operating system refuses a resource"), daemon._host_errors():
        raise error


def test_a_mistake_of_the_service_stays_one():
    with pytest.raises(RuntimeError, match="dictionary changed"), daemon._host_errors():
        raise RuntimeError("dictionary changed size during iteration")


def test_a_child_whose_pipes_cannot_be_closed_has_ended():
    pipe = SimpleNamespace(close=refuse)
    process = SimpleNamespace(poll=lambda: 0, wait=lambda timeout_s: 0, stdin=pipe, stdout=pipe)
    child = cast(Child, SimpleNamespace(process=process, kill=lambda: None, wait=lambda timeout_s: 0))
    child.close_stdin = lambda: Child.close_stdin(child)  # type: ignore[method-assign]
    assert Child.end(child)


@pytest.mark.parametrize(("name", "option"), [(None, ""), ("stage", "--name stage ")])
def test_a_refusal_after_a_trip_names_the_service_in_its_remedy(name: str | None, option: str):
    service = Service(PAPER, name=name)
    service.faults.append("a dead loop")
    for request in (service.arm, service.start):
        with pytest.raises(Refusal, match=f"the service is tripped; use reset first \\(`rtloop ctl {option}reset`\\)$"):
            request()


@pytest.mark.parametrize("flags", [0, int(Flag.WRITE_FAILED)])
def test_mode_off_that_the_loop_refuses_is_a_success_only_where_the_outputs_move(flags: int):
    """A tripped or stopping loop refuses mode off; a loop whose driver refuses every write is stopping, too."""

    def submit(*_: object, **__: object) -> int:
        raise RefusedByLoop(Kind.SET_MODE, 7)

    service, row = Service(PAPER), np.zeros(FLAGS + 1)
    row[FLAGS] = flags
    service.supervisor = cast(Any, SimpleNamespace(latest=lambda: row))
    service._desk = cast(Any, SimpleNamespace(submit=submit))
    if not flags:
        assert service.set_mode("off") == 7
        return
    with pytest.raises(Refusal, match="mode off: the driver refuses every write: the outputs do not move"):
        service.set_mode("off")


def refuse_command(*_: object, **__: object) -> Any:
    """Raise the error of a full queue of commands."""
    raise QueueFull("256 commands wait for the loop already; try again")


@pytest.fixture
def busy_service() -> Service:
    """Return a service whose loop accepts no more commands."""
    service = Service(PAPER)
    service._desk = cast(Any, SimpleNamespace(submit=refuse_command))
    service.supervisor = cast(Any, SimpleNamespace(latest=lambda: np.zeros(max(FLAGS, MODE) + 1), error=None))
    service.armed = True
    prepared = SimpleNamespace(plan=SimpleNamespace(axes="x", table=[]), configuration=service.configuration)
    references = SimpleNamespace(restore_configured=refuse_command, client_counts=())
    service.live = cast(Any, SimpleNamespace(prepared=prepared, references=references))
    return service


def test_a_start_that_finds_the_queue_full_is_a_latched_fault(busy_service: Service):
    busy_service._prepare_and_start()
    assert busy_service.faults == ["256 commands wait for the loop already; try again"]


def test_a_disagreement_is_latched_although_the_stop_finds_the_queue_full(busy_service: Service):
    opinion = SimpleNamespace(compute=lambda _: None, faults=["axis x: the margins differ"])
    busy_service.second_opinion = cast(Any, opinion)
    busy_service._judge_loop(cast(Any, None))
    assert busy_service.faults == ["axis x: the margins differ"]


def test_a_reload_that_finds_the_queue_full_ends_for_systemd(busy_service: Service, monkeypatch: pytest.MonkeyPatch):
    sent: list[str] = []
    busy_service.notifier = cast(Any, SimpleNamespace(send=lambda **fields: sent.append(next(iter(fields)))))
    busy_service._is_ready = True
    monkeypatch.setattr(busy_service, "reload_now", refuse_command)
    busy_service._apply_reload()
    assert sent == ["RELOADING", "READY"]


def test_a_watched_loop_has_its_events_followed_before_it_overwrites_them(monkeypatch: pytest.MonkeyPatch):
    service, followed, result = Service(PAPER), list[bool](), SimpleNamespace(notes=[])
    polls = [result, None, None]
    block = SharedBlock.create(Sizes(columns=20, axes=1, rate_hz=1000.0, snapshot_bytes=64, table_samples=0))
    recorder = SimpleNamespace(removals=[])
    supervisor: Any = SimpleNamespace(
        poll=lambda: polls.pop(), latest=lambda: None, ticks=0, block=block, recorder=recorder
    )
    service.live = cast(Any, SimpleNamespace(references=SimpleNamespace(follow=lambda: followed.append(True))))
    monkeypatch.setattr(service, "_notify_systemd", lambda _: None)
    assert service._watch(supervisor) is result
    assert followed == [True, True, True]  # once more at the end: the last events belong to the recording too
