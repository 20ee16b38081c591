"""Every kind of valid MCAP file is opened, or refused with a reason; tests.soak.conformance tries all variants."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from rtloop.cli import main
from rtloop.recording.load import load
from tests.interchange.conformance import CONTENTS, Variant, variants

NO_RECORDING, NOT_SUITABLE, LISTED = 66, 1, 2
"""Exit codes: of `info`; of `import` for unreadable messages; of `import` that lists the columns to select from."""
REASONS = ("an MCAP file without messages", "messages are encoded as a")


def invoke(*arguments: str | Path) -> Result:
    """Run a command in this process. Its only exception may be SystemExit."""
    result = CliRunner().invoke(main, [*map(str, arguments)])
    assert result.exception is None or isinstance(result.exception, SystemExit), (arguments, result.exc_info)
    assert "Traceback" not in result.output
    return result


def check(variant: Variant, folder: Path) -> None:
    """Require the outcome of `info` and `import` that fits the content of a variant."""
    path, output = folder / "other.mcap", folder / "imported.mcap"
    path.write_bytes(variant.data())
    info = invoke("info", path)
    assert info.exit_code == NO_RECORDING, (str(variant), info.output)
    assert "an MCAP file, but not a recording of rtloop" in info.output, (str(variant), info.output)
    assert ("'example'" in info.output) == (variant.messages > 0), (str(variant), info.output)
    listed = invoke("import", path, "--out", output)
    assert listed.exit_code == (LISTED if variant.numbers else NOT_SUITABLE), (str(variant), listed.output)
    if not variant.numbers:
        assert REASONS[variant.messages > 0] in listed.output, (str(variant), listed.output)
        return
    imported = invoke("import", path, "--all", "--out", output, "--json")
    assert imported.exit_code == (0 if variant.messages > 1 else NOT_SUITABLE), (str(variant), imported.output)
    if variant.messages > 1:
        assert json.loads(imported.stdout)["ticks"] == variant.messages
        assert load(output)["value"].tolist() == list(range(variant.messages))
        output.unlink()


@pytest.mark.parametrize("content", CONTENTS)
def test_a_file_of_the_conformance_suite_is_opened_or_refused_with_a_reason(content: str, tmp_path: Path):
    for variant in variants(max_features=0):
        if variant.content == content:
            check(variant, tmp_path)
