"""A service where the host refuses a system call that its loop does not need: it goes on, and its end comes."""

from __future__ import annotations

import errno
import os
import socket
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from rtloop.engine.messages import Kind
from rtloop.errors import UnavailableError
from rtloop.service import daemon
from rtloop.service.desk import Refusal, RefusedByLoop
from rtloop.service.notify import Notifier
from rtloop.service.service import Service
from rtloop.signals import FLAGS, Flag
from rtloop.supervision.child import Child
from tests.service.test_run import PAPER


def refuse(*_: object, **__: object) -> Any:
    raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))


def test_a_manager_that_cannot_be_told_stops_no_loop(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("NOTIFY_SOCKET", "/nowhere")
    notifier = Notifier()
    monkeypatch.setattr(socket, "socket", refuse)
    notifier.send(READY=1)


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left"), RuntimeError("can't start new thread")])
def test_what_the_host_refuses_is_said_in_a_sentence(error: Exception):
    with pytest.raises(UnavailableError, match="the host refuses what the service needs"), daemon._host_errors():
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
    for refused in (service.arm, service.start):
        with pytest.raises(Refusal, match=f"the service is tripped; use reset first \\(`rtloop ctl {option}reset`\\)$"):
            refused()


@pytest.mark.parametrize("flags", [0, int(Flag.WRITE_FAILED)])
def test_mode_off_that_the_loop_refuses_is_a_success_only_where_the_outputs_move(flags: int):
    """The loop refuses it while it is tripped or stops; it stops, too, while its driver refuses every write."""

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
