"""The site has no dead link, loads no remote file, and documents every key, command, signal, request and name."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Iterable, Iterator
from functools import cache
from importlib import import_module
from types import SimpleNamespace
from typing import Any
from urllib.parse import unquote, urlsplit

import click
import pytest

import rtloop
import rtloop.laws
from rtloop import signals
from rtloop.cli import main
from rtloop.configuration.field_texts import texts_below
from rtloop.configuration.schema import configuration_schema
from rtloop.foundation.options import Options
from rtloop.service.api.requests import REQUESTS
from tests.site.conftest import ROOT, Page

NOT_IN_FILES = {"HostDelay", "LawOptions", "FeedforwardOptions", "ControllerOptions"}
"""Models of options that occur in no file: a service's state, and base classes of the laws' options."""
FILES = {
    "configuration": ("rtloop.configuration", "rtloop.laws", "rtloop.drivers", "rtloop.hil"),
    "specification": ("rtloop.design",),
    "campaign": ("rtloop.campaigns",),
}
"""Packages that define the options of each kind of file."""


def test_a_link_leads_to_a_page_and_an_anchor_of_it(site: dict[str, Page]):
    by_path = {page.path.resolve(): page for page in site.values()}
    dead = set()
    for name, page in site.items():
        for link in page.links:
            address = urlsplit(link)
            if address.scheme or name == "404":
                continue
            path = (page.path.parent / unquote(address.path)).resolve() if address.path else page.path.resolve()
            path = path / "index.html" if path.is_dir() else path
            anchor = unquote(address.fragment)
            if not path.exists() or (anchor and path in by_path and anchor not in by_path[path].anchors):
                dead.add(f"{name}: {link}")
    assert dead == set()


def test_an_anchor_is_used_once_on_a_page(site: dict[str, Page]):
    assert {f"{name}: {anchor}" for name, page in site.items() for anchor in page.duplicates} == set()


def test_no_page_loads_anything_from_another_host(site: dict[str, Page]):
    loaded = {(name, address) for name, page in site.items() for address in page.loaded}
    assert {entry for entry in loaded if urlsplit(entry[1]).netloc} == set()
    assert len(site) > 30


def test_every_page_of_docs_is_in_the_site(site: dict[str, Page]):
    sources = {path.relative_to(ROOT / "docs").with_suffix("") for path in (ROOT / "docs").rglob("*.md")}
    pages = {path for path in sources if not path.name.startswith("+")}  # News fragments.
    expected = {str(path.parent / "index") if path.name == "README" else str(path) for path in pages}
    assert expected - site.keys() == set()


def _subclasses(model: type) -> Iterator[type]:
    """Yield all subclasses of a class."""
    for subclass in model.__subclasses__():
        yield subclass
        yield from _subclasses(subclass)


@cache
def _annotations() -> str:
    """Import all modules with models of options, and return the annotations of the fields of all models."""
    for top, package in (("rtloop", ""), ("drivers", "rtloop."), ("hil", "rtloop.")):  # The last two by links.
        for path in (ROOT / top).rglob("*.py"):
            if "Options(" in path.read_text(encoding="utf-8") and path.parent.name != "cli":
                import_module(package + ".".join(path.relative_to(ROOT).with_suffix("").parts))
    fields = (field for model in _subclasses(Options) for field in model.model_fields.values())
    return " ".join(str(field.annotation) for field in fields)


def _models(packages: tuple[str, ...]) -> set[type[Any]]:
    """Return the models of options that `packages` define, without base classes that no field refers to."""
    annotations = _annotations()
    return {
        model
        for model in _subclasses(Options)
        if model.__module__.startswith(packages)
        and model.__name__ not in NOT_IN_FILES
        and (not model.__subclasses__() or f".{model.__name__}" in annotations)
    }


def missing_keys(page: Page, packages: tuple[str, ...]) -> set[str]:
    """Return "model.key" of each key of the packages' models that a page has no row for."""
    return {
        f"{model.__name__}.{key}"
        for model in _models(packages)
        for key in model.model_fields
        if key not in page.first_cells(model.__name__)
    }


@pytest.mark.parametrize("name", FILES)
def test_every_key_of_a_file_has_an_entry(site: dict[str, Page], name: str):
    page = site[f"reference/{name}"]
    assert missing_keys(page, FILES[name]) == set()
    cells = [row for rows in page.rows.values() for row in rows if row]
    assert all(row[1] and row[2] for row in cells), "a key lacks its type or its default"


def test_a_key_without_an_entry_is_found(site: dict[str, Page]):
    page = site["reference/configuration"]
    rows = page.rows["LimitsOptions"]
    page.rows["LimitsOptions"] = [row for row in rows if row[:1] != ["bump_s"]]
    try:
        assert missing_keys(page, FILES["configuration"]) == {"LimitsOptions.bump_s"}
    finally:
        page.rows["LimitsOptions"] = rows


def keys_without_text(models: Iterable[Any]) -> set[str]:
    """Return "model.key" of each key whose text, without articles, has less than two words or only words of the key."""
    without = set()
    for model in models:
        texts = texts_below(model)
        for key in model.model_fields:
            words = set(re.findall(r"[a-z0-9]+", texts.get(key, "").lower())) - {"a", "an", "of", "the"}
            if len(words) < 2 or words <= set(key.split("_")):
                without.add(f"{model.__name__}.{key}")
    return without


def test_every_key_that_a_user_may_write_has_a_text_of_its_own():
    models = _models((*(room for rooms in FILES.values() for room in rooms), "rtloop.experiments"))
    assert len(models) > 60
    assert keys_without_text(models) == set()


def test_a_key_without_a_text_is_found(monkeypatch: pytest.MonkeyPatch):
    model = SimpleNamespace(__name__="Written", model_fields=("gain", "rate_hz", "rise_s", "file"))
    texts = {"gain": "The gain.", "rate_hz": "The rate, Hz.", "file": "Path of the samples."}
    monkeypatch.setitem(globals(), "texts_below", lambda _: texts)
    assert keys_without_text([model]) == {"Written.gain", "Written.rate_hz", "Written.rise_s"}


@pytest.mark.parametrize("name", FILES)
def test_the_page_of_a_file_shows_the_text_of_every_key(site: dict[str, Page], name: str):
    rows = {heading: rows for heading, rows in site[f"reference/{name}"].rows.items() if any(rows)}
    empty = {f"{heading}.{row[0]}" for heading, cells in rows.items() for row in cells if row and not row[4]}
    assert empty == set()


def test_the_schema_has_the_text_of_every_key():
    definitions = configuration_schema()["$defs"]
    for model in _models(FILES["configuration"]):
        properties = definitions.get(model.__name__, {}).get("properties", {})
        for key, text in texts_below(model).items():
            assert key not in properties or properties[key]["description"] == " ".join(text.split())
        assert {key for key, schema in properties.items() if not schema.get("description")} == set(), model


def _commands(command: click.Command, words: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """Yield (words, command) of a command and its subcommands, in the order of its listing."""
    yield words, command
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            subcommand = command.get_command(context, name)
            assert subcommand is not None
            yield from _commands(subcommand, (*words, name))


def test_every_command_and_option_has_an_entry(site: dict[str, Page]):
    page = site["reference/commands"]
    missing = set()
    for words, command in _commands(main, ("rtloop",)):
        if command.hidden:
            continue
        if "-".join(words) not in page.anchors:
            missing.add(" ".join(words))
        documented = " ".join(page.first_cells("-".join(words)))
        options = [name for p in command.params if isinstance(p, click.Option) and not p.hidden for name in p.opts]
        missing |= {f"{' '.join(words)} {name}" for name in options if name not in documented.replace(",", " ").split()}
    assert missing - {"rtloop --help"} == set()


def test_every_signal_mode_and_flag_has_an_entry_with_its_unit_and_meaning(site: dict[str, Page]):
    rows = {row[0]: row[1:] for rows in site["reference/signals"].rows.values() for row in rows if row}
    for signal in signals.COMMON_SIGNALS:
        assert rows[signal.name] == [signal.unit, signal.meaning]
    for signal in signals.AXIS_SIGNALS:
        assert rows[f"x_{signal.name}"] == [signal.unit, signal.meaning]
    anchors = site["reference/signals"].anchors
    assert {f"mode.{mode.name}" for mode in signals.Mode} | {f"flag.{flag.name}" for flag in signals.Flag} <= anchors


def test_every_request_and_field_has_an_entry(site: dict[str, Page]):
    page = site["reference/requests"]
    for request in REQUESTS:
        anchor = f"{request.method.lower()}-{request.path.removeprefix('/')}"
        assert anchor in page.anchors
        fields = set(request.body.model_fields) if request.body else set()
        assert page.first_cells(anchor) == fields


def test_every_public_name_of_python_has_an_entry_with_its_docstring(site: dict[str, Page]):
    text = " ".join(site["reference/python"].path.read_text(encoding="utf-8").split())
    for module in (rtloop, rtloop.laws):
        for name in module.__all__:
            if name.startswith("_"):
                continue
            assert f"{module.__name__}.{name}" in site["reference/python"].anchors
            value = getattr(module, name)
            assert value.__doc__, name
            first_words = " ".join(inspect.cleandoc(value.__doc__).split("`")[0].split()[:4])
            assert first_words in text.replace("&#39;", "'"), name


def test_the_search_finds_a_key_without_a_server(site: dict[str, Page]):
    folder = site["index"].path.parent
    script = (folder / "search/search_index.js").read_text(encoding="utf-8")
    documents = json.loads(script.removeprefix("var __index = "))["docs"]
    assert any(
        "tracking_error_um" in entry["text"] and entry["location"].startswith("reference/") for entry in documents
    )
    assert (folder / "assets/iframe-worker.js").exists()
    assert "assets/iframe-worker.js" in site["index"].path.read_text(encoding="utf-8")


def test_examples_have_the_text_of_their_files(site: dict[str, Page]):
    anchors = site["reference/examples"].anchors
    files = [*(ROOT / "deploy").glob("*.toml"), *(ROOT / "deploy/laws").glob("*.toml")]
    names = {str(path.relative_to(ROOT / "deploy").with_suffix("")).replace("/", "-") for path in files}
    assert len(names) > 15
    assert names <= anchors
