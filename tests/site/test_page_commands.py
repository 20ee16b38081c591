"""Each command and snippet of docs/ is executed here or by the test in its plan, or the plan says why it is not."""

from __future__ import annotations

import copy
import shutil
import tomllib
from pathlib import Path
from typing import Any

import pytest

from rtloop.configuration.schema import configuration_schema
from tests.site.page_code import ROOT
from tests.site.page_plan import (
    ALL_OTHERS,
    PagePlan,
    executable_snippets,
    execute_page,
    executed_snippets,
    plans,
    run_command,
)
from tests.site.snippets import Snippet, snippets

DOCS = ROOT / "docs"
PAGES = {path.name: path for path in sorted(DOCS.rglob("*.md")) if path.name != "README.md"}
EXECUTED = [path for path in PAGES.values() if executed_snippets(path)]
NOT_CONFIGURATIONS = {"data.md", "experiments.md"}
"""Pages whose TOML is no configuration but a mapping of columns or a specification."""
FOREIGN = {"project"}
"""Sections of TOML on the pages that are part of a pyproject.toml."""
MIN_REASON_WORDS = 2


def test_a_plan_names_a_page_and_what_stands_there():
    assert plans().keys() <= PAGES.keys()
    stale = []
    for name, plan in plans().items():
        page_snippets = executable_snippets(PAGES[name])
        for key in (*plan.elsewhere, *plan.not_run, *plan.exits):
            if key != ALL_OTHERS and not any(snippet.text.startswith(key) for snippet in page_snippets):
                stale.append(f"{name}: {key}")
        text = "\n".join(snippet.text for snippet in executed_snippets(PAGES[name]))
        stale += [f"{name}: {old}" for old in plan.replace if old not in text]
    assert stale == []


def test_what_is_not_executed_here_has_a_reason_or_the_place_where_it_is():
    for name, plan in plans().items():
        assert [reason for reason in plan.not_run.values() if len(reason.split()) < MIN_REASON_WORDS] == [], name
        assert [place for place in plan.elsewhere.values() if not (ROOT / place).exists()] == [], name


def test_programs_of_commands_are_known():
    """No block of kind "text" begins with a prompt or with the name of an installed program."""
    first_words = {
        (path.name, word)
        for path in PAGES.values()
        for snippet in snippets(path)
        if snippet.kind == "text" and (word := (snippet.text.split(maxsplit=1) or [""])[0])
        if word == "$" or shutil.which(word)
    }
    assert first_words == set()


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("page", [pytest.param(path, id=path.name) for path in EXECUTED])
def test_the_commands_of_a_page_run(page: Path, tmp_path: Path):
    execute_page(page, tmp_path)


def _merge(raw: dict[str, Any], part: dict[str, Any]) -> None:
    """Merge `part` into the configuration `raw`; a table with `kind`, `file` or `form` replaces that of its name."""
    for key, value in part.items():
        if isinstance(value, dict) and isinstance(raw.get(key), dict) and not value.keys() & {"kind", "file", "form"}:
            _merge(raw[key], value)
        else:
            raw[key] = value


def toml_faults(text: str) -> list[str]:
    """Return the errors that jsonschema reports for a part of a configuration, merged into deploy/paper.toml."""
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    raw = copy.deepcopy(tomllib.loads((ROOT / "deploy/paper.toml").read_text(encoding="utf-8")))
    part = tomllib.loads(text)
    if isinstance(part.get("axis"), dict):
        _merge(raw["axis"][0], part.pop("axis"))
    _merge(raw, part)
    if "channels" not in raw["driver"]:
        raw["driver"]["channels"] = {"x": {"input": "adc0", "output": "dac0", "um_per_v": 10.0}}
    errors = jsonschema.Draft202012Validator(configuration_schema()).iter_errors(raw)
    return [f"{error.json_path}: {error.message}" for error in errors]


TOML = [
    pytest.param(snippet.text, id=f"{path.name}-{number}")
    for path in PAGES.values()
    for number, snippet in enumerate(snippets(path))
    if snippet.kind == "toml" and path.name not in NOT_CONFIGURATIONS
]


@pytest.mark.parametrize("text", TOML)
def test_toml_on_a_page_is_part_of_a_valid_configuration(text: str):
    if tomllib.loads(text).keys() & FOREIGN:
        return
    assert toml_faults(text) == []


def test_a_wrong_key_in_toml_is_found():
    assert toml_faults("[axis.limits]\ndrive_volt = 10.0\n") != []
    assert toml_faults("[axis.limits]\ndrive_v = 9.0\n") == []


def test_blocks_of_a_page_have_kinds(tmp_path: Path):
    page = tmp_path / "page.md"
    page.write_text(
        "Text\n\n    $ rtloop run \\\n        a.toml\n    rtloop laws  # all\n\n    [loop]\n    rate_hz = 1\n\n"
        "- item\n\n    - item of an item\n\nText\n\n    # a.py\n    import x\n\n    y = 1\n\n    Σ = 0\n\n"
        "```sh\nfalse\n```\n```matlab\nload\n```\n"
    )
    assert list(snippets(page)) == [
        Snippet("shell", "rtloop run \\\n    a.toml"),
        Snippet("shell", "rtloop laws  # all"),
        Snippet("toml", "[loop]\nrate_hz = 1"),
        Snippet("python", "# a.py\nimport x\n\ny = 1\n\nΣ = 0"),
        Snippet("shell", "false"),
        Snippet("matlab", "load"),
    ]


def test_a_command_that_fails_fails_its_page(tmp_path: Path):
    with pytest.raises(AssertionError, match="ended with 3"):
        run_command("exit 3", [0], tmp_path, {})
    run_command("exit 3", [3], tmp_path, {})


def test_a_plan_takes_the_entry_with_which_a_command_begins():
    plan = PagePlan(elsewhere={"rtloop run": "tests"}, not_run={"sudo": "needs root here"})
    entries = [plan.entry(Snippet("shell", text)) for text in ("rtloop run x", "sudo x", "rtloop check x")]
    assert entries == ["rtloop run", "sudo", None]
