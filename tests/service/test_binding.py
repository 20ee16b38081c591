"""Binding of the control socket replaces neither a file nor a link nor the socket of a running service."""

from __future__ import annotations

import contextlib
import socket
import stat
from pathlib import Path

import pytest
from click.testing import CliRunner

from rtloop.cli import main
from rtloop.errors import RtloopError
from rtloop.service.daemon import _bind


def test_a_file_in_the_sockets_place_stays(tmp_path: Path):
    file, link, dangling = tmp_path / "thesis.tex", tmp_path / "link", tmp_path / "dangling"
    file.write_text("years of work")
    link.symlink_to(file)
    dangling.symlink_to(tmp_path / "nothing")
    for path in (file, link, dangling, tmp_path):
        with pytest.raises(RtloopError, match="is not a socket") as caught:
            _bind(path, 0o660)
        assert caught.value.exit_code in (69, 78)
        assert str(path) in str(caught.value)
    assert file.read_text() == "years of work"
    assert link.is_symlink()
    assert dangling.is_symlink()


def test_a_socket_that_nobody_serves_any_more_is_replaced(tmp_path: Path):
    path = tmp_path / "folder" / "lab.sock"
    _bind(path, 0o660).close()
    with contextlib.closing(_bind(path, 0o600)):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        with pytest.raises(RtloopError, match="another service uses this control socket"):
            _bind(path, 0o660)
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(path))


def test_the_name_of_a_service_is_no_pattern(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name in ("lab[b]", "labb"):
        _bind(tmp_path / f"{name}.sock", 0o660).close()
    monkeypatch.setattr("rtloop.supervision.paths.client_folders", lambda: [tmp_path])
    for name in ("lab[b]", "labb"):
        result = CliRunner().invoke(main, ["ctl", "--name", name, "status"])
        assert result.exit_code == 69
        assert f"{tmp_path}/{name}.sock: no service answers at this socket" in result.stderr
