"""Drivers are found by their kind, among the built-in ones and the entry points of installed packages."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.drivers.errors import DriverError, MissingLibrary
from rtloop.drivers.registry import driver_class, kinds
from rtloop.drivers.sim import SimDriver
from rtloop.errors import ConfigError
from tests.drivers.installing import write_distribution
from tests.engine.harness import AXIS, text

ENTRY_POINTS = """[rtloop.drivers]
acme = acme_card:AcmeDriver
sim = acme_card:AcmeDriver
absent = acme_absent:Driver
nameless = acme_card:Nothing
failing = acme_failing:Driver
torn = acme_torn:Driver
"""
MODULE = """
from rtloop.drivers.base import Channel, Facts, Options
from rtloop.drivers.python import PythonDriver


class AcmeOptions(Options):
    port: int = 1


class AcmeDriver(PythonDriver):
    kind = "acme"
    options_model = AcmeOptions

    @property
    def facts(self):
        return Facts((Channel("in0"),), (Channel("out0", -5.0, 5.0),), max_rate_hz=2000.0, real=False)

    def start(self): ...
    def stop(self): ...
    def read(self): return (0.0,)
    def write(self, volts): ...
"""


@pytest.fixture
def acme(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install a distribution `acme-card` with working and broken entry points."""
    (tmp_path / "acme_card.py").write_text(MODULE)
    (tmp_path / "acme_failing.py").write_text("1 / 0\n")
    (tmp_path / "acme_torn.py").write_text("print(\n")
    write_distribution(tmp_path, "acme-card", "1.0", ENTRY_POINTS)
    monkeypatch.syspath_prepend(tmp_path)


def acme_text(rate_hz: float = 1000, drive_v: float = 5.0, options: str = "port = 3") -> str:
    """Return the text of a configuration with the driver `acme`."""
    head = text(mode="raw", rate_hz=rate_hz).replace('"sim"', '"acme"').replace("adc0", "in0").replace("dac0", "out0")
    head = head.replace("seed = 1", options).replace("latency_ticks = 0", "")
    return f"{head}{AXIS}[axis.limits]\ndrive_v = {drive_v}\n"


@pytest.mark.usefixtures("acme")
def test_an_entry_point_is_found_but_cannot_replace_a_built_in():
    assert list(kinds()) == sorted(kinds())
    assert driver_class("acme").__module__ == "acme_card"
    assert driver_class("sim") is SimDriver


@pytest.mark.usefixtures("acme")
@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("absent", "driver 'absent': acme_absent:Driver cannot be imported: No module named 'acme_absent'"),
        ("nameless", "driver 'nameless': acme_card:Nothing cannot be imported: .*no attribute 'Nothing'"),
        ("failing", "driver 'failing': acme_failing:Driver cannot be imported: division by zero"),
        ("torn", "driver 'torn': acme_torn:Driver cannot be imported: '\\(' was never closed"),
    ],
)
def test_an_entry_point_that_is_broken_says_how(kind, message):
    with pytest.raises(MissingLibrary, match=message):
        driver_class(kind)
    assert issubclass(MissingLibrary, DriverError)


@pytest.mark.usefixtures("acme")
def test_a_configuration_reaches_it():
    prepared = prepare(parse(acme_text(), "acme", Path(), "acme.toml"))
    assert prepared.plan.driver_options == {"port": 3}
    assert prepared.plan.driver().kind == "acme"


@pytest.mark.usefixtures("acme")
@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"rate_hz": 2500}, "loop.rate_hz: 2500 Hz; allowed with driver 'acme': at most 2000 Hz"),
        ({"drive_v": 7.5}, "axis.x.limits.drive_v: 7.5 V; allowed: within the driver's ±5.0 V"),
        ({"options": "prot = 3"}, "driver.prot: unknown key; did you mean port?"),
    ],
)
def test_its_facts_are_checked_with_the_configuration(changes, fault):
    with pytest.raises(ConfigError) as caught:
        prepare(parse(acme_text(**changes), "acme", Path(), "acme.toml"))
    assert caught.value.faults == [fault]
