"""Commands of `rtloop ctl` on a running loop: each changes, or shows, what its name says."""

from __future__ import annotations

import json
from typing import Any

from prometheus_client.parser import text_string_to_metric_families

from tests.command_line import run
from tests.virtual.bench import VirtualBench


def ctl(bench: VirtualBench, *arguments: object) -> str:
    """Run `rtloop ctl ARGUMENTS` on the bench's service, which must succeed; return its standard output."""
    result = run("ctl", "--socket", bench.client.path, *arguments)
    assert result.exit_code == 0, result.output
    return result.stdout


def axis_status(bench: VirtualBench) -> dict[str, Any]:
    """Return the newest signals of axis x."""
    return bench.client.get("/status")["axes"]["x"]


def gain(bench: VirtualBench) -> float:
    """Return the gain of the controller of axis x that is in force."""
    return bench.client.get("/configuration")["values"]["axis"][0]["controller"]["gain"]


def test_the_mode_of_the_axes_is_changed(virtual: VirtualBench):
    for mode in ("raw", "feedforward", "closed_loop"):
        ctl(virtual, "mode", mode)
        virtual.wait_for(lambda mode=mode: virtual.client.get("/status")["mode"] == mode, f"mode {mode}")
    refused = run("ctl", "--socket", virtual.client.path, "mode", "sideways")
    assert refused.exit_code == 2
    assert "'sideways' is not one of 'off', 'raw', 'feedforward', 'closed_loop'" in refused.output


def test_a_reference_is_given_as_a_line_of_toml(virtual: VirtualBench):
    ctl(virtual, "reference", "x", 'kind = "hold", value = 12.5')
    virtual.wait_for(lambda: axis_status(virtual)["reference_um"] == 12.5, "the reference of 12.5 µm")
    refused = run("ctl", "--socket", virtual.client.path, "reference", "x", 'kind = "hold", value = 99.0')
    assert refused.exit_code == 1
    assert "99" in refused.stderr
    assert axis_status(virtual)["reference_um"] == 12.5


def test_a_changed_gain_is_previewed_and_undone(virtual: VirtualBench):
    before = gain(virtual)
    figures = json.loads(ctl(virtual, "preview", "x", "controller", f"gain = {before / 2}"))
    assert gain(virtual) == before
    assert figures == virtual.client.post(
        "/preview", {"axis": "x", "section": "controller", "values": {"gain": before / 2}}
    )
    ctl(virtual, "tune", "x", "controller", f"gain = {before / 2}")
    assert gain(virtual) == before / 2
    ctl(virtual, "undo", "x")
    assert gain(virtual) == before


def test_metrics_are_printed_in_the_format_of_prometheus(virtual: VirtualBench):
    families = {family.name: family for family in text_string_to_metric_families(ctl(virtual, "metrics"))}
    (ticks,) = families["rtloop_ticks"].samples
    assert 0 < ticks.value <= virtual.ticks


def test_a_stopped_loop_has_the_state_stopped(virtual: VirtualBench):
    ctl(virtual, "stop")
    virtual.await_state("stopped")
    assert json.loads(ctl(virtual, "status"))["state"] == "stopped"
