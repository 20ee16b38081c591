"""`rtloop ctl learn`: a scan that a running loop learns."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from rtloop.design.identification.model_sections import write_new_file
from rtloop.service.client import Client
from rtloop.service.client.client import MEASUREMENT_TIMEOUT_S
from rtloop.terminal.machine import echo_json
from rtloop.terminal.table import console, table


def learn(client: Client, body: Mapping[str, Any], out: Path | None, as_json: bool) -> int:
    """Have a running service learn; at Ctrl-C what was held is held again. Raises RtloopError."""
    content = client.move("/learn", body, MEASUREMENT_TIMEOUT_S)
    if out is not None:
        rows = zip(content["reference_um"], content["command_um"], strict=True)
        write_new_file(out, "".join(f"{reference!r}, {command!r}\n" for reference, command in rows))
    if as_json:
        echo_json(content)
        return 0
    shown = table("cycle", "rms error / nm", "largest / nm")
    for number, cycle in enumerate(content["cycles"]):
        shown.add_row(str(number), f"{1e3 * cycle['rms_um']:.1f}", f"{1e3 * cycle['largest_um']:.1f}")
    console().print(shown)
    click.echo(f"{content['ended']}; it goes on playing" + (f"\n{out}" if out else ""))
    return 0
