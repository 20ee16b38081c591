"""`rtloop schema`: the validator jsonschema accepts every shipped configuration and refuses mistakes."""

from __future__ import annotations

import copy
import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from rtloop.cli import main
from rtloop.drivers.registry import BUILT_IN as DRIVERS
from rtloop.laws.registry import BUILT_IN as LAWS

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
RAW = {path.relative_to(DEPLOY): tomllib.loads(path.read_text()) for path in sorted(DEPLOY.glob("**/*.toml"))}
CONFIGURATIONS = {str(path): raw for path, raw in RAW.items() if "loop" in raw}


@pytest.fixture(scope="module")
def validator() -> Any:
    """Return a validator for the printed schema; skip the tests without jsonschema."""
    # An import at the top would take 1.5 s in every process of `make test` that collects this file.
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    result = CliRunner().invoke(main, ["schema"])
    assert result.exit_code == 0
    kind = jsonschema.Draft202012Validator
    schema = json.loads(result.output)
    kind.check_schema(schema)
    return kind(schema)


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_every_configuration_is_accepted(validator: Any, name: str) -> None:
    assert [error.message for error in validator.iter_errors(CONFIGURATIONS[name])] == []


def make_mistakes() -> dict[str, Callable[[Any], Any]]:
    """Return functions that each make a mistake in the values of deploy/paper.toml, by the name of the mistake."""
    return {
        "unknown key of the loop": lambda raw: raw["loop"].update(rate=1.0),
        "text for a number": lambda raw: raw["loop"].update(rate_hz="10000"),
        "rate out of range": lambda raw: raw["loop"].update(rate_hz=-1),
        "unknown section": lambda raw: raw.update(loops={}),
        "missing section": lambda raw: raw.pop("driver"),
        "unknown key of the axis": lambda raw: raw["axis"][0].update(limit={}),
        "unknown key of the law": lambda raw: raw["axis"][0]["controller"].update(gian=1.0),
        "key of another law": lambda raw: raw["axis"][0]["controller"].update(ki_per_s=1.0),
        "feedforward as controller": lambda raw: raw["axis"][0].update(controller={"kind": "prandtl_ishlinskii"}),
        "unknown key of the driver": lambda raw: raw["driver"].update(sead=1),
        "unknown key of the rig": lambda raw: raw["driver"]["plant"]["sensor"].update(noise=1.0),
        "text in a channel": lambda raw: raw["driver"]["channels"]["x"].update(um_per_v="10"),
        "unknown reference": lambda raw: raw["axis"][0].update(reference={"kind": "step", "levels": [1.0]}),
    }


@pytest.mark.parametrize("mistake", make_mistakes())
def test_a_mistake_is_refused(validator: Any, mistake: str) -> None:
    raw = copy.deepcopy(CONFIGURATIONS["paper.toml"])
    make_mistakes()[mistake](raw)
    assert not validator.is_valid(raw)


def test_tables_of_other_packages_and_files_may_have_any_key(validator: Any) -> None:
    raw = copy.deepcopy(CONFIGURATIONS["paper.toml"])
    raw["axis"][0]["controller"] = {"file": "mine.py", "kp": 1.0}
    raw["driver"] = {"kind": "mycard", "device": "/dev/mycard0", "channels": raw["driver"]["channels"]}
    assert validator.is_valid(raw)


def test_all_laws_and_drivers_that_ship_are_in_it(validator: Any) -> None:
    definitions = validator.schema["$defs"]
    tables = [definitions[name]["anyOf"] for name in ("ControllerOptions", "FeedforwardOptions", "Driver")]
    titles = {choice["title"] for choices in tables for choice in choices}
    assert titles >= LAWS.keys() | DRIVERS.keys()


def test_fields_have_the_texts_of_their_models(validator: Any) -> None:
    spin_us = validator.schema["$defs"]["LoopOptions"]["properties"]["spin_us"]
    assert spin_us["description"] == "Spin instead of sleep for the last microseconds before a deadline."


def test_the_schema_can_be_written_to_a_file(tmp_path: Path) -> None:
    path = tmp_path / "rtloop.schema.json"
    assert CliRunner().invoke(main, ["schema", "--out", str(path)]).exit_code == 0
    assert json.loads(path.read_text())["$schema"].startswith("https://json-schema.org/")
