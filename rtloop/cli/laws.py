"""`rtloop laws` and `rtloop law new`: list the laws, and write the beginning of a new one."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import JSON, OUTPUT, MatchingText
from rtloop.cli.output import echo_json
from rtloop.cli.output.tables import console, escape, table
from rtloop.errors import ConfigError, OutputError, output_errors

LAW_NAME = MatchingText(
    "name", r"[a-z][a-z0-9_]{0,31}", "small letters, digits and '_', a letter first, at most 32 characters"
)
"""A name that is valid for a file, a module and a class."""
LAW_TEMPLATE = '''"""{title}: what it does, and where its equation is from.

    v = kp e + I,    I' = ki e + (what was applied of v, less v)
"""

from rtloop.laws import Controller, ControllerOptions


class {title}Options(ControllerOptions):
    kp: float = 0.0
    ki_per_s: float


class {title}(Controller):
    options_model = {title}Options
    coefficients = {{"kp": float, "ki": float}}
    state = {{"integral_um": float}}

    def build(self):
        return {{"kp": self.options.kp, "ki": self.options.ki_per_s * self.period_s}}

    def output(c, s, told):
        return c.kp * told.error_um + s.integral_um

    def update(c, s, told):
        s.integral_um += c.ki * told.error_um + told.applied_um - told.command_um

    def enter(c, s, told):
        s.integral_um = told.command_um - c.kp * told.error_um
'''


TEST_TEMPLATE = '''"""{title} keeps what the loop relies on: pytest test_{name}.py"""

from {name} import {title}, {title}Options

from rtloop.laws.conformance import LawConformance


class Test{title}(LawConformance):
    law = {title}({title}Options(ki_per_s=150.0), 1e-4, None)
'''


EXAMPLE_TEMPLATE = """# {title} on the simulated rig: rtloop check {name}.toml; rtloop run {name}.toml --duration 2

[loop]
rate_hz = 10000
# laws = ["pid"]               # further laws, to be swapped in while the loop runs

[driver]
kind = "sim"

[driver.channels.x]
input = "adc0"
output = "dac0"
um_per_v = 10.0

[[axis]]
name = "x"

# The rig's actuator; yours: rtloop identify hysteresis
[axis.feedforward]
thresholds_v = [0.095, 0.38, 0.84, 1.46, 2.21, 3.07, 4.01, 4.98, 5.96, 6.89, 7.76, 8.52, 9.14, 9.61, 9.9]
weights_um_per_v = [
    2.55, 0.57, 1.3, -1.57, 1.25, -0.054, -0.032, 0.66, 0.16, -0.77, 2.02, -1.63, -0.15, 2.99, -1.09,
]

[axis.controller]
file = "{name}.py"
ki_per_s = 150.0

# The rig's dynamics, for margins; yours: rtloop identify dynamics
[axis.model]
gain = -20.7
numerator = [
    [1.0, -1.22e5], [1.0, 2.99e4], [1.0, -2.776e4], [1.0, -1.07e4], [1.0, 1430.0], [1.0, 4.3e4, 3.2e9],
]
denominator = [[1.0, 925.0, 4.59e5], [1.0, 55.0, 1.4e7], [1.0, 1.54e4, 4.0e9], [1.0, 964.0, 3.95e9]]

[axis.reference]
kind = "steps"
levels = [20.0, 0.0, -20.0, 0.0]
dwell_s = 0.2
"""


@click.command()
@JSON
@report_errors
def laws(as_json: bool) -> None:
    """List the shipped laws and the laws of installed packages."""
    entries = list_laws()
    echo_json({"laws": entries}) if as_json else _print_laws(entries)


@click.group()
def law() -> None:
    """Write the files of a new law."""


@law.command()
@click.argument("name", type=LAW_NAME)
@click.option("--out", type=OUTPUT, default=Path(), help="Folder for the three files [the current folder].")
@report_errors
def new(name: str, out: Path) -> None:
    """Write NAME.py, its test and an example configuration.

    The law in NAME.py is a PI controller that runs; docs/laws.md explains how to change it.
    """
    for path in write_law_files(name, out):
        click.echo(path)
    click.echo(f"next: rtloop check {out / name}.toml")


def list_laws() -> list[dict[str, Any]]:
    """Return for each registered kind {kind, slot, about (the docstring's first line), shipped, problem, defined_in}.

    `problem` is the reason that prevents its use; slot and about are then None. Laws of other packages run first in the
    limited process, which is killed if a law does not return.
    """
    from rtloop.laws.limited.trial import try_limited
    from rtloop.laws.registry import BUILT_IN, find_law, kinds, law_class

    entries = []
    for kind, module in kinds().items():
        is_shipped = kind in BUILT_IN
        entry: dict[str, Any] = {"kind": kind, "slot": None, "about": None, "shipped": is_shipped, "problem": None}
        try:
            if not is_shipped:
                try_limited(f"law {kind!r}", find_law, kind)
            law = law_class(find_law(kind))
            about = next(iter((law.__doc__ or "").strip().splitlines()), None)
            entry |= {"slot": law.records().slot, "about": about}
        except ValueError as error:
            entry["problem"] = str(error)
        except ConfigError as error:
            entry["problem"] = "; ".join(error.faults)
        entries.append(entry | {"defined_in": module})
    return entries


def write_law_files(name: str, folder: Path) -> list[Path]:
    """Write a law, its test and a configuration to `folder`, which is created. Returns their paths.

    Raises OutputError where one exists already (none is written then), or if the system refuses.
    """
    from rtloop.foundation.trusted import make_file

    title = "".join(part.capitalize() for part in name.split("_"))
    texts = {f"{name}.py": LAW_TEMPLATE, f"test_{name}.py": TEST_TEMPLATE, f"{name}.toml": EXAMPLE_TEMPLATE}
    paths = [folder / file for file in texts]
    for path in paths:
        if os.path.lexists(path):
            raise OutputError(f"{path}: the file exists already and is not overwritten", errno.EEXIST)
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for path, text in zip(paths, texts.values(), strict=True):
            with os.fdopen(make_file(path), "w", encoding="utf-8") as file:
                file.write(text.format(title=title, name=name))
    return paths


def _print_laws(entries: Sequence[dict[str, Any]]) -> None:
    """Print the registered kinds as a table."""
    rows = table("kind", "slot", "what it is", "comes with", words=(1, 2, 3))
    for entry in entries:
        about = f"[red]{escape(entry['problem'])}[/]" if entry["problem"] else escape(entry["about"] or "")
        origin = "rtloop" if entry["shipped"] else escape(entry["defined_in"])
        rows.add_row(entry["kind"], entry["slot"] or "", about, origin)
    console().print(rows)
    hint = '\nYour own law: file = "mine.py" in [axis.controller]. To write an example: rtloop law new mine'
    console().print(escape(hint))
