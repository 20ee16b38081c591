"""One self-contained HTML page of a verification: tables and pictures, no network, no other file, no script."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

from rtloop.design.verification.text import HEADINGS, NOTE, ROBUSTNESS_HEADINGS, answer, robustness, shifts, table
from rtloop.design.verification.verify import Verification

STYLE = """
:root { color-scheme: light dark }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem }
table { border-collapse: collapse; margin: 1rem 0 }
th, td { padding: .2rem .8rem .2rem 0; text-align: left; border-bottom: 1px solid #8884 }
td { font-variant-numeric: tabular-nums }
.MISSED, .NO { color: #d33; font-weight: 600 } .met { color: #2a2 }
img { max-width: 100%; background: white; margin: .5rem 0 }
"""


def page(title: str, axes: Sequence[tuple[str, Verification, dict[str, bytes]]]) -> str:
    """The page of all axes: (name, what was found, PNG files by name) each."""
    body = "".join(_axis(name, found, drawn) for name, found, drawn in axes)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>\n'
        f"<style>{STYLE}</style></head>\n<body><h1>{escape(title)}</h1>\n{body}</body></html>\n"
    )


def _axis(name: str, found: Verification, drawn: dict[str, bytes]) -> str:
    parts = [f"<h2>axis {escape(name)}</h2>\n<p><b>{escape(answer(found))}.</b></p>\n", _table(HEADINGS, table(found))]
    if found.robustness.shifts:
        parts += ["<h3>The resonance may move by</h3>\n", _table(("", ""), shifts(found))]
    parts += [f"<h3>Robustness</h3>\n<p>{escape(NOTE)}</p>\n", _table(ROBUSTNESS_HEADINGS, robustness(found))]
    parts += [f"<p>Warning: {escape(warning)}.</p>\n" for warning in found.warnings]
    parts += [_picture(label, content) for label, content in drawn.items()]
    return "".join(parts)


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(heading)}</th>" for heading in headings)
    lines = "".join(f"<tr>{''.join(map(_cell, row))}</tr>\n" for row in rows)
    return f"<table><tr>{head}</tr>\n{lines}</table>\n"


def _cell(text: str) -> str:
    mark = f' class="{text}"' if text in ("met", "MISSED", "NO") else ""
    return f"<td{mark}>{escape(text)}</td>"


def _picture(label: str, content: bytes) -> str:
    data = base64.b64encode(content).decode("ascii")
    return f'<img alt="{escape(label)}" src="data:image/png;base64,{data}">\n'
