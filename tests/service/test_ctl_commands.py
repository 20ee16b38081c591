"""Commands of `rtloop ctl` on a running loop: each changes, or shows, what its name says."""

from __future__ import annotations

import json
from typing import Any

from prometheus_client.parser import text_string_to_metric_families

from tests.command_line import run
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for


def ctl(bench: Bench, *arguments: object) -> str:
    """Run `rtloop ctl ARGUMENTS` on the bench's service, which must succeed; return its standard output."""
    result = run("ctl", "--socket", bench.client.path, *arguments)
    assert result.exit_code == 0, result.output
    return result.stdout


def axis_status(bench: Bench) -> dict[str, Any]:
    """Return the newest signals of axis x."""
    return bench.client.get("/status")["axes"]["x"]


def gain(bench: Bench) -> float:
    """Return the gain of the controller of axis x that is in force."""
    return bench.client.get("/configuration")["values"]["axis"][0]["controller"]["gain"]


def test_the_mode_of_the_axes_is_changed(running: Bench):
    for mode in ("raw", "feedforward", "closed_loop"):
        ctl(running, "mode", mode)
        wait_for(lambda mode=mode: running.client.get("/status")["mode"] == mode, f"mode {mode}")
    refused = run("ctl", "--socket", running.client.path, "mode", "sideways")
    assert refused.exit_code == 2
    assert "'sideways' is not one of 'off', 'raw', 'feedforward', 'closed_loop'" in refused.output


def test_a_reference_is_given_as_a_line_of_toml(running: Bench):
    ctl(running, "reference", "x", 'kind = "hold", value = 12.5')
    wait_for(lambda: axis_status(running)["reference_um"] == 12.5, "the reference of 12.5 µm")
    refused = run("ctl", "--socket", running.client.path, "reference", "x", 'kind = "hold", value = 99.0')
    assert refused.exit_code == 1
    assert "99" in refused.stderr
    assert axis_status(running)["reference_um"] == 12.5


def test_a_changed_gain_is_previewed_and_undone(running: Bench):
    before = gain(running)
    figures = json.loads(ctl(running, "preview", "x", "controller", f"gain = {before / 2}"))
    assert gain(running) == before
    assert figures == running.client.post(
        "/preview", {"axis": "x", "section": "controller", "values": {"gain": before / 2}}
    )
    ctl(running, "tune", "x", "controller", f"gain = {before / 2}")
    assert gain(running) == before / 2
    ctl(running, "undo", "x")
    assert gain(running) == before


def test_metrics_are_printed_in_the_format_of_prometheus(running: Bench):
    families = {family.name: family for family in text_string_to_metric_families(ctl(running, "metrics"))}
    (ticks,) = families["rtloop_ticks"].samples
    assert 0 < ticks.value <= running.ticks


def test_watch_prints_as_many_lines_as_asked(running: Bench):
    lines = [json.loads(line) for line in ctl(running, "watch", "--count", 3).splitlines()]
    assert [line["state"] for line in lines] == ["running"] * 3
    ticks = [line["tick"] for line in lines]
    assert ticks == sorted(set(ticks))


def test_a_stopped_loop_has_the_state_stopped(running: Bench):
    ctl(running, "stop")
    running.await_state("stopped")
    assert json.loads(ctl(running, "status"))["state"] == "stopped"
