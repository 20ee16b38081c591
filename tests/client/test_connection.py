"""`rtloop.connect` offers each request of the service and each command of `rtloop ctl`, with bodies that it accepts."""

from __future__ import annotations

import re
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rtloop
from rtloop.cli import main
from rtloop.client import Client
from rtloop.client.connection import Connection, read_controller
from rtloop.client.control import BUILD_RESOURCES, Cancellation
from rtloop.errors import ConfigError, LoopFault, UnavailableError
from rtloop.service.api.lanes import Lane
from rtloop.service.api.requests import REQUESTS as SERVICE_REQUESTS
from tests.paper_configuration import TEXT
from tests.service.test_retune import HZ, Service, overshoot

TABLE = {"form": "state_space", "a": [[0.5]]}
REQUESTS: dict[str, tuple[Any, dict[str, Any]]] = {
    "/arm": (lambda loop: loop.arm(), {}),
    "/start": (lambda loop: loop.start(), {}),
    "/stop": (lambda loop: loop.stop(), {}),
    "/reset": (lambda loop: loop.reset(), {}),
    "/reload": (lambda loop: loop.reload(), {}),
    "/mode": (lambda loop: loop.mode("raw"), {"mode": "raw"}),
    "/setpoint": (lambda loop: loop.setpoint("x", 1.5), {"axis": "x", "value": 1.5}),
    "/reference": (
        lambda loop: loop.reference("x", kind="sine", amplitude=5.0),
        {"axis": "x", "reference": {"kind": "sine", "amplitude": 5.0}},
    ),
    "/waveform": (
        lambda loop: loop.waveform("x", np.arange(2), np.array([0.5, 1.0]), hold_ticks=3, repeat=True),
        {"axis": "x", "samples": [0.0, 1.0], "hold_ticks": 3, "repeat": True, "command_um": [0.5, 1.0]},
    ),
    "/tune": (
        lambda loop: loop.tune("x", "controller", gain=0.012),
        {"axis": "x", "section": "controller", "values": {"gain": 0.012}},
    ),
    "/preview": (
        lambda loop: loop.preview("x", "limits", command_um=40.0),
        {"axis": "x", "section": "limits", "values": {"command_um": 40.0}},
    ),
    "/undo": (lambda loop: loop.undo("x"), {"axis": "x"}),
    "/controller": (lambda loop: loop.controller("x", TABLE), {"axis": "x", "controller": TABLE}),
    "/response": (
        lambda loop: loop.response("x", duration_s=2.0, near_hz=600.0),
        {"axis": "x", "duration_s": 2.0, "near_hz": 600.0},
    ),
    "/learn": (
        lambda loop: loop.learn("x", np.zeros(4), cycles=2, keep=False),
        {"axis": "x", "samples": [0.0] * 4, "cycles": 2, "resonance_percent": 2.0, "keep": False},
    ),
}
"""Call of the connection's method and the body that this method sends, for each resource."""
SERVED = {request.path: request for request in SERVICE_REQUESTS if request.method == "POST" and request.path != "/lock"}
METHOD_NAMES = {"lock": "take", "resonance": "response"}
"""Method of each command of `rtloop ctl` that has another name: `resonance` is a response with `resonance_only`."""


class RecordingClient:
    """Client that appends each request to `requests` and answers it with tick 7."""

    def __init__(self) -> None:
        self.requests: list[tuple[str, dict[str, Any]]] = []

    def post(self, resource: str, body: dict[str, Any] | None = None, *_: object) -> dict[str, Any]:
        self.requests.append((resource, body or {}))
        return {"tick": 7}

    measure = post


@pytest.mark.parametrize("resource", SERVED)
def test_each_request_of_the_service_is_a_method_whose_body_the_service_accepts(resource: str):
    call, body = REQUESTS[resource]
    client = RecordingClient()
    assert call(Connection(client)) in (7, {"tick": 7}, None)  # type: ignore[arg-type]
    assert client.requests == [(resource, body)]
    if (model := SERVED[resource].body) is not None:
        model.model_validate(body)


def test_the_client_waits_longest_for_the_requests_that_build_a_law():
    assert {path for path, request in SERVED.items() if request.lane is Lane.BUILD} == BUILD_RESOURCES


def test_each_command_of_ctl_is_a_member_of_the_connection():
    ctl: Any = main.commands["ctl"]
    names = {METHOD_NAMES.get(name, name) for name in ctl.commands}
    assert names <= set(dir(Connection)), names - set(dir(Connection))
    assert {"configuration", "capture", "swap"} <= set(dir(Connection))


def test_a_controller_comes_from_a_configuration_file_that_has_one_for_the_axis(tmp_path: Path):
    config, client = tmp_path / "other.toml", RecordingClient()
    config.write_text(TEXT)
    section = read_controller(config, "x")
    Connection(client).controller("x", config)  # type: ignore[arg-type]
    assert client.requests == [("/controller", {"axis": "x", "controller": section})]
    assert section["form"]
    with pytest.raises(ConfigError, match=r"no controller for axis 'q'; the axes of this file are x"):
        read_controller(config, "q")


def test_a_retuning_proposes_taps_that_only_a_swap_puts_in_force(tmp_path: Path):
    service = Service(tmp_path, 1.06 * HZ)
    loop = Connection(service)  # type: ignore[arg-type]
    proposal = loop.retune("x", within_percent=0.0)
    assert (proposal.is_better, service.tuned) == (True, {})
    assert proposal.after.settling_ms < proposal.before.settling_ms
    assert loop.swap(proposal) == 1234
    assert overshoot(1.06 * HZ, service.tuned) < 0.011
    with pytest.raises(LoopFault, match="changed since the proposal"):
        loop.swap(proposal._replace(replaced=proposal.taps))


@pytest.mark.parametrize("has_note", [True, False])
def test_who_finds_a_dead_service_is_told_the_name_to_park(tmp_path: Path, has_note: bool) -> None:
    """A killed service leaves its socket and its file `.hardware`; a socket without this file may have any name."""
    path = tmp_path / "bench1.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    if has_note:
        path.with_suffix(".hardware").touch()
    option = " --name bench1" if has_note else ""
    remedy = (
        f"`rtloop park CONFIG{option}`, unless that was done since, then start the service with "
        f"`rtloop serve CONFIG{option}`"
    )
    with pytest.raises(UnavailableError, match=f"the service has died.* {remedy}$"):
        Client(path).get("/status")


def test_a_cancellation_ends_each_connection_attached_before_or_after_it():
    cancellation = Cancellation()
    for is_first in (True, False):
        ours, peer = socket.socketpair()
        with ours, peer:
            cancellation.attach(ours)
            if is_first:
                cancellation.cancel()
            peer.settimeout(1.0)
            assert peer.recv(1) == b""


def test_the_documentation_tells_properties_from_methods():
    """The table in docs/service.md has each name in a row of its kind: properties or methods, as the class has it."""
    page = (Path(__file__).parents[2] / "docs" / "service.md").read_text(encoding="utf-8")
    table = page[page.index("| name | use |") :].split("\n\n")[0]
    rows = [line.strip("|").split("|")[:2] for line in table.splitlines()[2:]]
    is_property = {
        name: use.strip().startswith(("property", "properties"))
        for names, use in rows
        for name in re.findall(r"`(\w+)", names)
    }
    public = {name: value for name, value in vars(Connection).items() if not name.startswith("_")}
    assert {"status", "configuration", "metrics", "watch", "swap"} <= is_property.keys() <= public.keys()
    assert is_property == {name: isinstance(public[name], property) for name in is_property}


def test_nobody_answers(tmp_path: Path):
    with pytest.raises(UnavailableError, match=r"nobody\.sock: no service answers at this socket"):
        rtloop.connect(tmp_path / "nobody.sock", as_="ada")
    with pytest.raises(UnavailableError, match="no service 'nowhere' has a control socket"):
        rtloop.connect("nowhere")
