"""Storage of a host's delay, its share of a margin, and the refusal to run without a known delay."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from rtloop.cli import main
from rtloop.configuration.file import Configuration, load, parse
from rtloop.configuration.prepare import prepare
from rtloop.errors import ConfigError, HostRefusal
from rtloop.supervision import host_delay
from rtloop.supervision.host_delay import HostDelay, load_host_delay, require_margins, spent_margin, store_host_delay
from tests.recording.real_loop import ROOT, changed_configuration

MARGIN_US = 73.05 / 360 / 95.09 * 1e6
"""Phase margin over crossover of the paper's loop at 10 kHz."""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Set and return the folder of runtime files; no other folder is searched."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))
    monkeypatch.setattr(host_delay, "client_folders", list)  # not the folders of this machine
    return tmp_path / "run"


def make_configuration(*changes: tuple[str, str]) -> Configuration:
    """Return the paper's configuration after replacements of texts."""
    return parse(changed_configuration(*changes), "host-delay-test", ROOT / "deploy", "paper.toml")


@pytest.fixture
def measured() -> Configuration:
    """Return a configuration with a stored lateness of 40 µs."""
    configuration = make_configuration()
    store_host_delay(configuration, lateness_us=40.0)
    return configuration


REQUIRED = ("# [axis.margins]  ", "[axis.margins]\nrequire_margin = true\n# ")


def test_measured_delays_are_stored_for_their_rate() -> None:
    configuration = make_configuration()
    assert load_host_delay(configuration) is None
    store_host_delay(configuration, lateness_us=40.0)
    store_host_delay(configuration, wire_ticks={"x": 3})
    assert load_host_delay(configuration) == HostDelay(rate_hz=10_000, lateness_us=40.0, wire_ticks={"x": 3})
    assert load_host_delay(make_configuration(("rate_hz = 10000\n", "rate_hz = 5000\n"))) is None


@pytest.mark.parametrize("content", ["", "{", "[]", '{"rate_hz": -1}', '{"rate_hz": 1e4, "lateness_us": "x"}'])
def test_an_unreadable_file_counts_as_not_measured(folder: Path, measured: Configuration, content: str) -> None:
    (folder / "host-delay-test.host.json").write_text(content)
    assert load_host_delay(measured) is None


def test_a_broken_file_does_not_hide_the_file_of_the_next_folder(
    tmp_path: Path, folder: Path, measured: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(host_delay, "client_folders", lambda: [folder])
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "first"))
    store_host_delay(measured, lateness_us=50.0)
    (tmp_path / "first" / "host-delay-test.host.json").write_text("{")
    assert load_host_delay(measured) == HostDelay(rate_hz=10_000, lateness_us=40.0)


def test_the_file_is_read_by_the_group_and_written_by_its_owner_alone(folder: Path) -> None:
    before = os.umask(0)
    try:
        store_host_delay(make_configuration(), lateness_us=40.0)
    finally:
        os.umask(before)
    assert (folder / "host-delay-test.host.json").stat().st_mode & 0o777 == 0o640


def test_a_file_that_others_may_write_is_ignored(folder: Path, measured: Configuration) -> None:
    os.chmod(folder / "host-delay-test.host.json", 0o666)
    assert load_host_delay(measured) is None
    os.chmod(folder, 0o777)
    with pytest.raises(HostRefusal, match="other users may write to this folder"):
        store_host_delay(measured, lateness_us=1.0)


def test_lateness_and_ticks_beyond_the_model_are_spent() -> None:
    """A held output takes one tick through a wire; the rig's latency of one is in the loop already."""
    configuration = make_configuration(("latency_ticks = 0", "latency_ticks = 1"))
    store_host_delay(configuration, lateness_us=40.0, wire_ticks={"x": 4})
    (check,), host = prepare(configuration).checks, load_host_delay(configuration)
    assert host is not None
    spent = spent_margin(check, host)
    assert spent is not None
    assert (spent.wire_ticks, spent.more_us) == (2, pytest.approx(240.0))
    assert spent.more_ticks == pytest.approx(2.4)
    assert spent.margin_us == pytest.approx(MARGIN_US - 100.0, rel=0.01)
    assert not spent.is_spent
    assert "240 µs = 2.4 ticks of added delay" in spent.text
    assert spent_margin(replace(check, on_model=None), host) is None


def test_a_required_margin_needs_a_known_delay_that_leaves_some() -> None:
    require_margins(prepare(make_configuration()))
    prepared = prepare(make_configuration(REQUIRED))
    require_margins(prepare(make_configuration(REQUIRED), paced=False))
    with pytest.raises(ConfigError, match="delay of this host is unknown"):
        require_margins(prepared)
    store_host_delay(prepared.configuration, lateness_us=MARGIN_US - 20.0)
    require_margins(prepared)
    store_host_delay(prepared.configuration, lateness_us=MARGIN_US + 20.0)
    with pytest.raises(
        ConfigError, match=r"require_margin: measured on this host: 215\d µs = .* no margin of stability is left"
    ):
        require_margins(prepared)
    with pytest.raises(ConfigError, match="require_margin: the delay margin of the axis is unknown, or its loop is"):
        require_margins(replace(prepared, checks=(replace(prepared.checks[0], on_model=None),)))


@pytest.mark.parametrize("exchange_us", [100.0, 300.0, 1000.0, MARGIN_US - 20.0, MARGIN_US + 20.0])
def test_the_delay_of_an_exchange_is_spent_and_forbids_a_run_where_it_is_all(exchange_us: float) -> None:
    """A network adds such delays; the self-test stores them."""
    prepared = prepare(make_configuration(REQUIRED))
    store_host_delay(prepared.configuration, exchange_us=exchange_us)
    host = load_host_delay(prepared.configuration)
    assert host is not None
    spent = spent_margin(prepared.checks[0], host)
    assert spent is not None
    assert (spent.exchange_us, spent.more_us, spent.more_ticks) == pytest.approx(
        (exchange_us, exchange_us, exchange_us / 100.0)
    )
    assert spent.is_spent == (exchange_us > MARGIN_US)
    if spent.is_spent:
        with pytest.raises(ConfigError, match=r"require_margin: .* no margin of stability is left"):
            require_margins(prepared)
    else:
        require_margins(prepared)


def test_the_page_of_a_verification_shows_the_delay_of_this_host(folder: Path) -> None:
    paper = ROOT / "deploy" / "paper.toml"
    store_host_delay(load(paper), lateness_us=40.0)
    result = CliRunner().invoke(main, ["design", "verify", str(paper), "--out", str(folder)])
    assert result.exit_code == 1, result.stderr  # the paper's loop misses what it claims
    assert "<p>Measured on this host: 40 µs = " in next(folder.glob("*.html")).read_text()


def test_a_run_without_a_known_delay_is_refused(tmp_path: Path) -> None:
    (tmp_path / "asking.toml").write_text(changed_configuration(REQUIRED, ('specification = "paper-spec.toml"', "")))
    result = CliRunner().invoke(main, ["run", str(tmp_path / "asking.toml"), "--duration", "1", "--out", str(tmp_path)])
    assert result.exit_code == 78
    assert "axis.x.margins.require_margin: the delay of this host is unknown" in result.stderr
    assert not list(tmp_path.glob("*.mcap*"))
