"""Every mistake in a configuration gives one line: key, value, allowed values; all mistakes come at once."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import get_args

import pytest
from pydantic import BaseModel

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.file import ChannelOptions, LoopOptions, load, parse
from rtloop.configuration.recording import RecordingOptions
from rtloop.configuration.service import ServiceOptions
from rtloop.configuration.text_files import InputFileError
from rtloop.errors import ConfigError
from rtloop.hil.options import RigOptions
from rtloop.signals import Mode
from tests.paper_configuration import CONTROLLER, PAPER, RATE, REFERENCE, TEXT, UNSTABLE, built, entry, faults


def test_the_papers_configuration_is_good():
    prepared = built()
    assert prepared.warnings == ()
    assert (prepared.plan.mode, prepared.plan.axes) == (Mode.CLOSED_LOOP, ("x",))


@pytest.mark.parametrize("keys", ["ki_per_s = 100.0", ""])
def test_a_controller_without_its_kind_is_told_the_kinds(keys):
    *_, fault = faults((CONTROLLER, f"[axis.controller]\n{keys}\n"))
    assert fault.startswith(
        "axis.x.controller: kind: missing, which means 'transfer'; allowed: coupled, integral_resonant, pid, "
        "positive_position, repetitive, transfer, an installed law"
    )


@pytest.mark.parametrize("name", ["absent.toml", "."])
def test_a_file_that_cannot_be_read(tmp_path, name):
    with pytest.raises(InputFileError, match=re.escape(str(tmp_path / name)) + ": (No such file|Is a directory)") as e:
        load(tmp_path / name)
    assert e.value.exit_code == 66


def test_a_file_that_is_not_text(tmp_path):
    path = tmp_path / "binary.toml"
    path.write_bytes(b"[loop]\n\xff\xfe")
    with pytest.raises(InputFileError, match="not a text file in UTF-8 \\(fault at byte 7\\)"):
        load(path)


def test_a_file_that_is_not_toml(tmp_path):
    path = tmp_path / "broken.toml"
    path.write_text("[loop]\nrate_hz = \n")
    with pytest.raises(ConfigError, match=r"broken\.toml: 1 fault\n  not valid TOML: .*line 2, column 11"):
        load(path)


ONE_FAULT = [
    # loop
    ((RATE, ""), "loop.rate_hz: missing; this key is required"),
    ((RATE, "rate_hz = 0\n"), "loop.rate_hz: 0: must be greater than 0"),
    ((RATE, "rate_hz = nan\n"), "loop.rate_hz: nan: must be a finite number"),
    ((RATE, 'rate_hz = "fast"\n'), "loop.rate_hz: 'fast': must be a valid number"),
    ((RATE, "rate_hz = true\n"), "loop.rate_hz: True: must be a valid number"),
    ((RATE, "rate_hz = 2e6\n"), "loop.rate_hz: 2000000.0: must be less than or equal to 1000000"),
    ((RATE, RATE + "priorty = 3\n"), "loop.priorty: unknown key; did you mean priority\\?"),
    ((RATE, RATE + "drive_v = 3\n"), "loop.drive_v: unknown key in this table; drive_v belongs in another table"),
    ((RATE, RATE + "xyzzy = 3\n"), "loop.xyzzy: unknown key"),
    ((RATE, RATE + 'mode = "on"\n'), "loop.mode: 'on': must be 'off', 'raw', 'feedforward' or 'closed_loop'"),
    (("[recording]", "[recrding]"), "recrding: unknown key; did you mean recording\\?"),
    # driver
    (('kind = "sim"', 'kind = "comedy"'), r"driver.kind: 'comedy' is not a known driver; allowed: .*\bsim\b.*"),
    (('kind = "sim"', ""), "driver.kind: missing; allowed: can, comedi, serial, shm, sim, udp"),
    (("latency_ticks = 0 ", "latency_ticks = 99 "), "driver.latency_ticks: 99: must be less than .* 16"),
    (('input = "adc0"', 'input = "adc7"'), "driver.channels.x: input 'adc7' with output 'dac0'; .*"),
    (("[driver.channels.x]", "[driver.channels.x]\nscale = 1"), "driver.channels.x.scale: unknown key"),
    (("um_per_v = 10.0\n# off", "um_per_v = 0.0\n# off"), "driver.channels.x: um_per_v: 0; allowed: any other .*"),
    # axis
    (("[[axis]]", "[axis]"), r"axis: a single table; allowed: a list of tables, each with the heading \[\[axis\]\]"),
    (('name = "x"', 'name = "X 1"'), "axis.X 1.name: 'X 1': String should match pattern .*"),
    (("[1.0, 7.9e6]", "[1.0, 5.0, 7.9e6], [1.0, 3.0]"), "axis.x.controller: improper: 7 zeros and 5 poles; .*"),
    (("gain = 0.016", "gain = nan"), "axis.x.controller.gain: nan: must be a finite number"),
    (("gain = 0.016", ""), "axis.x.controller: gain: missing; form 'factors' needs a gain"),
    (("gain = 0.016", "gain = 0.016\nd = 1.0"), "axis.x.controller: d: not part of form 'factors'; allowed: .*"),
    (("[0.095, 0.38,", "[0.095, inf,"), "axis.x.feedforward.thresholds_v.1: inf: must be a finite number"),
    (("2.55, 0.57,", "2.55, -57,"), "axis.x.feedforward: weights: .*; allowed: every partial sum above 0, .*"),
    (("prewarp_hz = 595.5", "prewarp_hz = 6e3"), "axis.x.controller: prewarp_hz: 6000.0 Hz; .* 0 and .* 5000 Hz"),
    (('method = "tustin" ', 'method = "euler" '), "axis.x.controller.method: 'euler': must be 'matched', .*"),
    (("drive_v = 10.0 ", "drive_v = 12.0 "), r"axis.x.limits.drive_v: 12.0 V; .* within the driver's ±10\.0 V"),
    (("drive_v = 10.0 ", "drive_v = -1.0 "), "axis.x.limits.drive_v: -1.0: must be greater than 0"),
    (("sensor_min_v = -9.99", "sensor_min_v = 9.99"), "axis.x.interlocks.sensor_min_v: 9.99 V; .* below .* 9.99 V"),
    (UNSTABLE, "axis.x.controller: the loop is unstable on axis.x.model at 10000 Hz .*; allow_unstable = true .*"),
    ((CONTROLLER, ""), "axis.x.controller: missing; mode closed_loop needs it"),
    # reference
    (("dwell_s = 0.2", "dwell_s = 1e-9"), "axis.x.reference.dwell_s: 1e-09 s; .* at least one period of 0.0001 s"),
    (('kind = "steps"', 'kind = "stairs"'), "axis.x.reference.kind: 'stairs'; allowed: 'hold', 'steps', .*"),
    (
        ('kind = "steps"', ""),
        "axis.x.reference.kind: missing; allowed: 'hold', 'steps', 'table', 'sine', 'triangle', 'chirp', 'input'",
    ),
    ((REFERENCE, 'kind = "table"\nfile = "absent.csv"\n\n'), "axis.x.reference.file: .*absent.csv: No such file .*"),
    ((REFERENCE, 'kind = "sine"\namplitude = 1.0\nfrequency_hz = 9999.0\n\n'),
     "axis.x.reference.frequency_hz: 9999 Hz; allowed: below half of the loop's rate, 5000 Hz"),
    ((REFERENCE, 'kind = "triangle"\namplitude = 1.0\nfrequency_hz = 5000.0\n\n'),
     "axis.x.reference.frequency_hz: 5000 Hz; .*"),
    ((REFERENCE, 'kind = "chirp"\namplitude = 1.0\nstart_hz = 1.0\nend_hz = 6e3\nduration_s = 1.0\n\n'),
     "axis.x.reference.end_hz: 6000 Hz; .*"),
    ((REFERENCE, 'kind = "hold"\nvalue = -60.5\n\n'),
     r"axis.x.reference: -60.5 µm; allowed: within ±60 µm \(interlocks.position_um\), where no interlock trips"),
    ((REFERENCE, 'kind = "input"\nchannel = "knob"\nper_v = 1.0\n\n'), "axis.x.reference.*'knob' is not a .* adc0"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "message"), ONE_FAULT, ids=lambda value: str(value)[:60])
def test_one_mistake_one_line(change, message):
    (fault,) = faults(change)
    assert re.fullmatch(message, fault), fault


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ('at_tick = -1\nmode = "off"', "schedule.0.at_tick: -1: must be greater than or equal to 0"),
        ('at_tick = 1\nmode = "of"', "schedule.0.mode: 'of': must be 'off', .*"),
        ("at_tick = 1", "schedule.0: 0 changes in one entry; allowed: exactly one of mode, reference, reset_trip"),
        ('at_tick = 1\nmode = "off"\nreset_trip = true', "schedule.0: 2 changes in one entry; .* exactly one of .*"),
        ('at_tick = 1\naxis = "x"\nmode = "off"', "schedule.0: axis: 'x' is set in an entry without a reference; .*"),
        ('at_tick = 1\naxis = "z"\nreference = {kind = "hold"}', "schedule.axis: 'z' is not an axis; the axes are x"),
        ('at_tick = 1\nreference = {kind = "sine", amplitude = 1.0, frequency_hz = 9999.0}',
         "schedule, at_tick 1: frequency_hz: 9999 Hz; allowed: below half .*"),
        ('at_tick = 7\nreference = {kind = "hold", value = 61.0}',
         "axis.x.reference from tick 7 on: 61 µm; allowed: within ±60 µm .*"),
        ('at_tick = 1\nreference = {kind = "table", file = "no.npy"}', "schedule, at_tick 1: file: .*no.npy: No .*"),
    ],
)  # fmt: skip
def test_one_mistake_in_the_schedule(lines, message):
    (fault,) = faults(more=entry(lines))
    assert re.fullmatch(message, fault), fault


def test_volts_of_mode_raw_are_no_setpoint_in_micrometres():
    changes = ((RATE, RATE + 'mode = "raw"\n'), (REFERENCE, 'kind = "hold"\nvalue = 9.0\n\n'))
    built(*changes, ("position_um = 60.0", "position_um = 6.0"))


def test_all_mistakes_at_once():
    all_faults = faults(
        (RATE, "rate_hz = -1\nspin = 3\n"),
        ('kind = "sim"', 'kind = "comedy"'),
        ("drive_v = 10.0 ", "drive_v = 0.0 "),
        ("dwell_s = 0.2", 'dwell_s = "long"'),
        more=entry("at_tick = 1"),
    )
    keys = [fault.split(":")[0] for fault in all_faults]
    assert sorted(keys) == sorted(
        ["loop.rate_hz", "loop.spin", "driver.kind", "axis.x.limits.drive_v", "axis.x.reference.dwell_s", "schedule.0"]
    )


def test_the_message_counts_and_lists():
    with pytest.raises(
        ConfigError, match=r"^paper\.toml: 2 faults\n  loop\.rate_hz: missing.*\n  loop\.x: unknown key$"
    ):
        parse(TEXT.replace(RATE, "x = 1\n"), "paper", PAPER.parent, "paper.toml")


def test_axes_and_channels_must_match():
    assert faults(("[driver.channels.x]", "[driver.channels.z]")) == [
        "driver.channels.x: missing; the axis needs input, output, um_per_v",
        "driver.channels.z: there is no axis of this name; the axes are x",
    ]
    again = '[[axis]]\nname = "x"\nfeedforward = { thresholds_v = [0.0], weights_um_per_v = [1.0] }\n'
    assert faults(more=again) == ["axis.x: two axes have this name; rename one of them"]


@pytest.mark.parametrize(
    ("poles", "place"), [("[[]]", "0.0"), ("[[[]]]", "0.0"), ("[[-1.0]]", "0.1"), ("[[0.0, 1.0], []]", "1.0")]
)
def test_a_root_that_lacks_a_part(poles: str, place: str):
    all_faults = faults((CONTROLLER, f'[axis.controller]\nform = "zpk"\ngain = 60.0\npoles = {poles}\n\n'))
    assert any(fault.startswith(f"axis.x.controller.poles.{place}: ") for fault in all_faults), all_faults


def test_a_repeated_entry_of_the_schedule_is_a_fault():
    (fault,) = faults(more=2 * entry('at_tick = 7\nmode = "off"'))
    assert fault == "schedule, at_tick 7: two equal entries; remove one of them"


def models_in(annotation: object) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
        for field in annotation.model_fields.values():
            yield from models_in(field.annotation)
    for part in get_args(annotation):
        yield from models_in(part)


@pytest.mark.parametrize(
    "section", [LoopOptions, ChannelOptions, RigOptions, AxisOptions, RecordingOptions, ServiceOptions]
)
def test_every_key_is_in_the_papers_configuration(section: type[BaseModel]) -> None:
    """The first lines of that file promise it; the key may be commented out."""
    for model in models_in(section):
        documented = [name for name in model.model_fields if re.search(rf"(?<![a-z_]){name}(?![a-z_])", TEXT)]
        assert documented == list(model.model_fields), model.__name__
