"""The control socket's place: what stands there already is not lost."""

from __future__ import annotations

import contextlib
import socket
import stat
from pathlib import Path

import pytest

from rtloop.errors import RtloopError
from rtloop.service.daemon import _bind


def test_a_file_in_the_sockets_place_stays(tmp_path: Path):
    file, link, dangling = tmp_path / "thesis.tex", tmp_path / "link", tmp_path / "dangling"
    file.write_text("years of work")
    link.symlink_to(file)
    dangling.symlink_to(tmp_path / "nothing")
    for path in (file, link, dangling, tmp_path):
        with pytest.raises(RtloopError, match="no socket") as caught:
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
        with pytest.raises(RtloopError, match="another service listens"):
            _bind(path, 0o660)
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(path))
