"""`rtloop schema`: the keys of a configuration as JSON Schema."""

from __future__ import annotations

from pathlib import Path

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import TARGET


@click.command()
@click.option("--out", type=TARGET, help="File to write.  [default: stdout]")
@report_errors
def schema(out: Path | None) -> None:
    """Print the JSON Schema of a configuration.

    An editor completes and checks the keys of a configuration whose first line is `#:schema ./rtloop.schema.json`. The
    schema has all laws and drivers that ship; `rtloop check` knows more, such as relations between keys.
    """
    from rtloop.configuration.schema import schema_text
    from rtloop.workbench.written_files import write_output

    if out is None:
        click.echo(schema_text(), nl=False)
    else:
        write_output(out, schema_text().encode())
        click.echo(f"{out} is written")
