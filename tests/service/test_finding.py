"""Which service `rtloop ctl` talks to, and what it says where that is none, or not the only one."""

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


@pytest.mark.parametrize(("there", "options", "said"), CASES)
def test_what_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there: list[str], options: list[str], said: str):
    for name in there:
        (tmp_path / f"{name}.sock").touch()
    monkeypatch.setattr("rtloop.supervision.paths.client_folders", lambda: [tmp_path])
    done = CliRunner().invoke(main, ["ctl", *options, "status"])
    assert done.exit_code == 69
    assert done.stderr == f"rtloop: {said.format(folder=tmp_path)}\n"


class Silent:
    """A service that grants every request without more words."""

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
    monkeypatch.setattr("rtloop.cli.ctl.make_client", lambda _: Silent())
    monkeypatch.setattr("sys.stdout.isatty", lambda: is_terminal)
    with pytest.raises(SystemExit, match="0"):
        main(["ctl", command])
    printed = capsys.readouterr().out
    assert printed.startswith(sentence) if is_terminal else printed == "{}\n"
