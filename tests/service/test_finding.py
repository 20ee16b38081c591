"""`rtloop ctl` finds the control socket of a service, and reports no match or several matches."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from rtloop.cli import main

CASES = [
    ([], [], "no service has a control socket in {folder}; start a service with `rtloop serve CONFIG`"),
    (
        ["y"],
        ["--name", "x"],
        "no service 'x' has a control socket in {folder}; start a service with `rtloop serve CONFIG`",
    ),
    (
        ["y"],
        ["--name", "deploy/x.toml"],
        "no service 'deploy/x.toml' has a control socket in {folder}; use the name of the service, 'x'; start a "
        "service with `rtloop serve CONFIG`",
    ),
    (["x", "y"], [], "several services have a control socket in {folder}: x, y; use --name NAME"),
]


@pytest.mark.parametrize(("names", "options", "text"), CASES)
def test_what_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, names: list[str], options: list[str], text: str):
    for name in names:
        (tmp_path / f"{name}.sock").touch()
    monkeypatch.setattr("rtloop.supervision.paths.client_folders", lambda: [tmp_path])
    result = CliRunner().invoke(main, ["ctl", *options, "status"])
    assert result.exit_code == 69
    assert result.stderr == f"rtloop: {text.format(folder=tmp_path)}\n"


class EmptyResponses:
    """Client whose requests all succeed with an empty response."""

    def post(self, *_: object) -> dict[str, str]:
        return {}

    delete = post


@pytest.mark.parametrize(
    ("command", "sentence"), [("arm", "armed: the outputs may be driven"), ("release", "the lock")]
)
@pytest.mark.parametrize("is_terminal", [True, False])
def test_a_response_without_content_is_a_sentence_on_a_terminal(
    command: str, sentence: str, is_terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("rtloop.cli.ctl.make_client", lambda _: EmptyResponses())
    monkeypatch.setattr("sys.stdout.isatty", lambda: is_terminal)
    with pytest.raises(SystemExit, match="0"):
        main(["ctl", command])
    printed = capsys.readouterr().out
    assert printed.startswith(sentence) if is_terminal else printed == "{}\n"
