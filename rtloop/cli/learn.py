"""`rtloop ctl learn`: a running loop learns a scan."""

from __future__ import annotations

from pathlib import Path
from typing import IO

import click

from rtloop.cli.ctl import AXIS, make_client, read_numbers
from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import JSON, TARGET, InputFile
from rtloop.cli.output import echo_json
from rtloop.workbench.tables import console, table


@click.command()
@AXIS
@click.argument("file", type=InputFile())
@click.option("--cycles", default=5, show_default=True, type=click.IntRange(1, 50), help="Number of learning cycles.")
@click.option(
    "--resonance-percent",
    default=2.0,
    show_default=True,
    type=click.FloatRange(0, 50, max_open=True),
    help="Uncertainty of the model's resonance, in ± %; learning starts only if it converges in this whole range.",
)
@click.option(
    "--out",
    type=TARGET,
    help="File to write: the learned table, which `rtloop ctl waveform` plays; an existing file is not overwritten.",
)
@JSON
@click.pass_context
@report_errors
def learn(
    context: click.Context, axis: str, file: IO[str], cycles: int, resonance_percent: float, out: Path | None,
    as_json: bool,
) -> None:  # fmt: skip
    """Learn the scan of AXIS whose period is in FILE.

    FILE has one number a line, in µm, for each tick of the period. The scan is played; after each cycle its error
    corrects the reference and a term that is added to the command. At the end the best table keeps playing. Ctrl-C
    restores the reference.
    """
    from rtloop.client.control import LONGEST_MEASUREMENT_S
    from rtloop.design.identification.model_sections import require_new, write_new_file

    require_new(out)
    rows = read_numbers(file)
    if rows and len(rows[0]) != 1:
        raise click.UsageError(
            f"{file.name}: two numbers in every line, as in a learned table; allowed: one number in every line, the "
            "reference. Use the file from which the table was learned"
        )
    samples = [number for (number,) in rows]
    body = {"axis": axis, "samples": samples, "cycles": cycles, "resonance_percent": resonance_percent}
    content = make_client(context).measure("/learn", body, LONGEST_MEASUREMENT_S)
    if out is not None:
        table_rows = zip(content["reference_um"], content["command_um"], strict=True)
        write_new_file(out, "".join(f"{reference!r}, {command!r}\n" for reference, command in table_rows))
    if as_json:
        echo_json(content)
        return
    errors = [
        (str(n), *(f"{1e3 * c[key]:.1f}" for key in ("rms_um", "largest_um"))) for n, c in enumerate(content["cycles"])
    ]
    console().print(table("cycle", "rms error / nm", "largest / nm", rows=errors))
    click.echo(f"learning ended: {content['ended']}; the best table keeps playing" + (f"\n{out}" if out else ""))
