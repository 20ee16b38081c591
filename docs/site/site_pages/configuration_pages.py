"""Pages of the three files that a user writes: configuration, specification and campaign."""

from __future__ import annotations

from collections.abc import Iterator

from pydantic import BaseModel

from rtloop.campaigns.campaign_file import CampaignOptions
from rtloop.configuration import file as configuration_file
from rtloop.configuration.file import ChannelOptions
from rtloop.design.synthesis.specification import DesignOptions
from rtloop.drivers.registry import BUILT_IN as DRIVERS
from rtloop.drivers.registry import driver_class
from rtloop.laws.contract import Feedforward
from rtloop.laws.registry import BUILT_IN as LAWS
from rtloop.laws.registry import LawReference, law_class
from site_pages.option_sections import Section, section_markdown, walk

ROOT = configuration_file.FileOptions  # The file's own model; [driver] stands beside it.
UNIT_NOTE = (
    "A name ends with its unit: `_um` is µm, `_v` is V, `_hz` is Hz. Numbers are finite, with a magnitude of 0 or from "
    "1e-100 to 1e100. Unknown keys are refused. Relative paths start at the file's folder, unless a key says "
    "otherwise.\n\n"
)


def configuration_page() -> str:
    """Return the page of all keys of a configuration."""
    seen: dict[type[BaseModel], Section] = {}
    sections: list[Section] = []
    top = Section("", "", ROOT)
    for section in walk(top, seen):
        if section.model.__name__ in ("FeedforwardOptions", "ControllerOptions"):
            del seen[section.model]
            sections += _laws(section, seen)
        else:
            sections.append(section)
    sections += _drivers(seen)
    text = (
        "# Configuration\n\nA configuration is one TOML file. `rtloop check FILE` reports all mistakes in it at once. "
        "[The examples](examples.md) show complete files with comments; `rtloop schema` writes the JSON Schema for an "
        "editor. "
        "`[driver]` names the hardware: [`[driver]`](#driver.sim).\n\n" + UNIT_NOTE
    )
    return text + "\n\n".join(section_markdown(section, seen) for section in sections)


def _laws(base: Section, seen: dict[type[BaseModel], Section]) -> Iterator[Section]:
    """Yield a section for each shipped law that fits below `base`, and the sections below it."""
    wants_feedforward = base.model.__name__ == "FeedforwardOptions"
    for kind in LAWS:
        law = law_class(LawReference(kind))
        if issubclass(law, Feedforward) == wants_feedforward:
            yield from walk(Section(base.header, f"{base.path}.{kind}", law.options_model, kind), seen)


def _drivers(seen: dict[type[BaseModel], Section]) -> Iterator[Section]:
    """Yield a section for the channels and for each driver that ships, and the sections below it."""
    yield from walk(Section("[driver.channels.AXIS]", "driver.channels", ChannelOptions), seen)
    for kind in sorted(DRIVERS, key=lambda kind: kind != "sim"):
        yield from walk(Section("[driver]", f"driver.{kind}", driver_class(kind).options_model, kind), seen)


def _file_page(title: str, introduction: str, model: type[BaseModel]) -> str:
    """Return the page of all keys of a file with one model."""
    seen: dict[type[BaseModel], Section] = {}
    sections = list(walk(Section("", "", model), seen))
    body = "\n\n".join(section_markdown(section, seen) for section in sections)
    return f"# {title}\n\n{introduction} {UNIT_NOTE}{body}"


def specification_page() -> str:
    """Return the page of all keys of a specification."""
    introduction = (
        "A specification states the model of a stage and the requirements on its loop. `rtloop design` reads it: "
        "[Design](../design.md). The tables `[plant]` and `[weights.…]` take a transfer function."
    )
    return _file_page("Specification", introduction, DesignOptions)


def campaign_page() -> str:
    """Return the page of all keys of a campaign."""
    introduction = "A campaign runs a configuration on many simulated rigs: [Campaigns](../campaigns.md)."
    return _file_page("Campaign", introduction, CampaignOptions)
