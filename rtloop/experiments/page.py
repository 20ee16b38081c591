"""The report as one self-contained HTML page: verdicts, pictures, tables, links to the recordings. No script."""

from __future__ import annotations

import base64
import time
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files as package_files
from typing import Any
from urllib.parse import quote

HEADINGS = {"asked": "asked", "claimed": "claimed", "model": "the model gives"}


def page(content: Mapping[str, Any], pictures: Mapping[str, Mapping[str, bytes]], links: Mapping[str, str],
         skipped: Mapping[str, str]) -> str:  # fmt: skip
    """The page; `links` are the recordings' paths relative to it, `skipped` reasons by experiment."""
    style = package_files("rtloop.experiments").joinpath("page.css").read_text(encoding="utf-8")
    title = f"{content['name']}: experiments"
    sections = [_section(section, pictures.get(section["name"], {}), links) for section in content["experiments"]]
    left_out = "".join(f"<li>{escape(name)}: {escape(reason)}</li>" for name, reason in skipped.items())
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><title>{escape(title)}</title>\n'
        f"<style>{style}</style></head>\n<body><header><h1>{escape(title)}</h1>\n{_origin(content)}</header>\n"
        f"{_summary(content)}"
        + (f"<h2>Not done</h2><ul>{left_out}</ul>\n" if skipped else "")
        + "".join(sections)
        + "</body></html>\n"
    )


def _origin(content: Mapping[str, Any]) -> str:
    """When, where, with what."""
    when = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(content["created_unix_ns"] / 1e9))
    clock = "paced by the clock" if content["paced"] else "virtual time"
    versions = ", ".join(f"{name} {version}" for name, version in content["versions"].items())
    host = content["host"]
    return (
        f"<p>{when} · driver {escape(content['driver'])}, {content['rate_hz']:g} Hz, {clock}<br>\n"
        f"{escape(str(host.get('cpu')))}, kernel {escape(str(host.get('kernel')))}<br>\n{escape(versions)}</p>\n"
    )


def _summary(content: Mapping[str, Any]) -> str:
    """Counts of verdicts, as an index of the page."""
    lines = []
    for section in content["experiments"]:
        verdicts = [row["mark"] for row in section["rows"]]
        counts = "".join(f'<td class="{kind}">{verdicts.count(kind) or ""}</td>' for kind in ("good", "mixed", "bad"))
        if section["problem"]:
            counts = f'<td class="bad" colspan="3">{escape(section["problem"])}</td>'
        link = f'<a href="#{section["name"]}">{escape(section["title"])}</a>'
        lines.append(f"<tr><td>{link}</td>{counts}</tr>\n")
    head = "<th>experiment</th><th>agrees</th><th>differs from claim or model</th><th>misses what is asked</th>"
    return f'<table class="index"><tr>{head}</tr>\n{"".join(lines)}</table>\n'


def compared(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """What these rows are compared with: keys of HEADINGS of which any of them has something."""
    return [key for key in HEADINGS if any(row[key] is not None for row in rows)]


def compared_cell(row: Mapping[str, Any], key: str) -> str:
    """A row's cell in such a column."""
    value = row[key]
    return "–" if value is None else f"{number(value)} ± {row['tolerance']:.2g}" if key == "model" else value


def _section(section: Mapping[str, Any], drawn: Mapping[str, bytes], links: Mapping[str, str]) -> str:
    body = [f'<section id="{section["name"]}"><h2>{escape(section["title"])}</h2>\n<p>{escape(section["about"])}</p>\n']
    if section["problem"]:
        body.append(f'<p class="bad">{escape(section["problem"])}</p>\n')
    if drawn:
        body.append(_picture(section["title"], drawn))
    if section["rows"]:
        body.append(_verdicts(section["rows"]))
    body += [f"<p class=note>{escape(note)}</p>\n" for note in section["notes"]]
    body += [_table(table) for table in section["tables"]]
    recordings = ", ".join(f'<a href="{quote(links[name])}">{escape(name)}</a>' for name in section["recordings"])
    missed = f" Periods missed: {section['periods_missed']}." if section["periods_missed"] else ""
    return "".join(body) + f"<p class=note>Recordings: {recordings}.{missed}</p></section>\n"


def _picture(title: str, drawn: Mapping[str, bytes]) -> str:
    """Dark on dark screens; paper is always light."""
    light, dark = (
        f"data:image/png;base64,{base64.b64encode(drawn[name]).decode('ascii')}" for name in ("light", "dark")
    )
    return (f'<picture><source media="screen and (prefers-color-scheme: dark)" srcset="{dark}">'
            f'<img alt="{escape(title)}" src="{light}"></picture>\n')  # fmt: skip


def _verdicts(rows: Sequence[Mapping[str, Any]]) -> str:
    keys = compared(rows)
    head = "".join(f"<th>{text}</th>" for text in ("quantity", *map(HEADINGS.get, keys), "this run gave", "verdict"))
    return f"<table><tr>{head}</tr>\n{''.join(_verdict(row, keys) for row in rows)}</table>\n"


def _verdict(row: Mapping[str, Any], keys: Sequence[str]) -> str:
    unit = "" if row["unit"] == "1" else f" {row['unit']}"
    run = "–" if row["run"] is None else f"<b>{number(row['run'])}</b>{escape(unit)}"
    beside = "".join(f"<td>{escape(compared_cell(row, key))}</td>" for key in keys)
    return (
        f"<tr><td>{escape(row['quantity'])}</td>{beside}<td>{run}</td>"
        f'<td class="{row["mark"]}">{escape(row["verdict"])}</td></tr>\n'
    )


def number(value: float) -> str:
    """Five digits at most."""
    return f"{value:.5g}"


def _table(table: Mapping[str, Any]) -> str:
    head = "".join(f"<th>{escape(heading)}</th>" for heading in table["headings"])
    lines = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>\n" for row in table["rows"])
    return (f"<details{' open' if len(table['rows']) <= 12 else ''}><summary>{escape(table['title'])}</summary>"
            f'<table class="numbers"><tr>{head}</tr>\n{lines}</table></details>\n')  # fmt: skip
