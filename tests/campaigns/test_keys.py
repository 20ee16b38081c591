"""Keys of a campaign: values are read from options and set in tables, and an unknown key is named."""

from __future__ import annotations

import pytest

from rtloop.campaigns.keys import is_rig_key, option_value, replace_values
from rtloop.configuration.file import load
from tests.campaigns.campaign_files import PAPER

TABLES = {"driver": {"kind": "sim", "plant": {"hysteresis": {"history_v": [1.0, 2.0]}}}, "axis": [{"name": "x"}]}


def test_values_are_set_in_a_copy():
    changed = replace_values(
        TABLES,
        {"driver.plant.hysteresis.history_v.1": 5.0, "axis.x.limits.drive_v": 9.0, "driver.plant.sensor.noise_um": 0.1},
    )
    assert changed["driver"]["plant"] == {"hysteresis": {"history_v": [1.0, 5.0]}, "sensor": {"noise_um": 0.1}}
    assert changed["axis"] == [{"name": "x", "limits": {"drive_v": 9.0}}]
    assert TABLES["driver"]["plant"] == {"hysteresis": {"history_v": [1.0, 2.0]}}


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("driver.kind.more", "driver.kind.more: 'more' follows the value 'sim', which is neither a table nor a list"),
        ("driver.plant.hysteresis.history_v.2", "no entry '2'; allowed: 0 … 1"),
        ("axis.y.limits.drive_v", "axis.y.limits.drive_v: no entry 'y'; allowed: x"),
    ],
)
def test_a_path_through_no_table_is_refused(key, message):
    with pytest.raises(ValueError, match=message):
        replace_values(TABLES, {key: 1.0})


def test_values_are_read_from_the_checked_options_with_defaults():
    configuration = load(PAPER)
    values = {
        "driver.latency_ticks": 0,
        "driver.plant.sensor.bandwidth_hz": None,
        "axis.x.feedforward.weights_um_per_v.3": -1.57,
        "axis.x.limits.drive_v": 10.0,
        "loop.rate_hz": 10000.0,
    }
    read = {key: option_value(configuration, configuration.driver_options, key) for key in values}
    assert read == values


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("driver.plant.dynamics.resonance", "no key 'resonance'; allowed: form, gain"),
        ("axis.y.limits.drive_v", "no axis 'y'; allowed: x"),
        ("axis.x.feedforward.weights_um_per_v.15", "no key '15'; allowed: 0 … 14"),
        ("laws.x", "unknown key; allowed: keys of driver, axis, loop, recording, service"),
    ],
)
def test_an_unknown_key_is_named_with_the_allowed_ones(key, message):
    configuration = load(PAPER)
    with pytest.raises(ValueError, match=message):
        option_value(configuration, configuration.driver_options, key)


def test_keys_of_the_rig_leave_the_law_as_it_is():
    assert all(map(is_rig_key, ("driver.plant.sensor.noise_um", "driver.latency_ticks")))
    assert not any(map(is_rig_key, ("axis.x.controller.gain", "driver.channels.x.um_per_v")))
