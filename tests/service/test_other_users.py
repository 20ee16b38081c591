"""A folder, socket, block, board or compiled code that another user has made first is not trusted."""

from __future__ import annotations

import contextlib
import os
import socket
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import rtloop.drivers.sim  # noqa: F401  (compiles at import: an unprivileged user has no folder for the cache)
from rtloop.client import Client
from rtloop.configuration.file import load
from rtloop.drivers.base import Wiring
from rtloop.drivers.shm import ShmDriver, ShmOptions
from rtloop.engine.memory import SharedBlock, Sizes
from rtloop.foundation.native.cache import _make_private_folder
from rtloop.hil import board
from rtloop.hil.options import BoardOptions
from rtloop.service.daemon import _bind
from rtloop.supervision import parking
from rtloop.supervision.paths import block_path, create_file, runtime_folder, socket_path
from tests.paper_configuration import PAPER
from tests.users import ATTACKER, ROOT_ONLY, VICTIM, Raised, as_user, clean_places

pytestmark = [
    pytest.mark.system,
    ROOT_ONLY,
    pytest.mark.skipif(os.stat("/tmp").st_mode & 0o1777 != 0o1777, reason="/tmp is not shared"),
]
SIZES = Sizes(columns=1, axes=1, rate_hz=1000.0, snapshot_bytes=8, table_samples=1)
FORGED_V = 9.9


@pytest.fixture
def user_folder() -> Iterator[Path]:
    """Yield the path of the victim's runtime folder in /tmp, which does not exist yet."""
    with clean_places() as folder:
        yield folder


@pytest.fixture
def config(user_folder: Path) -> Iterator[Path]:
    """Yield the path of a copy of the paper's configuration that every user may read."""
    path = Path(f"/tmp/rtloop-test-{os.getpid()}.toml")
    path.write_text(PAPER.read_text())
    yield path
    path.unlink()


def socket_binder(config: Path) -> Callable[[], Any]:
    """Return a function that binds the control socket; it returns the path, and the modes of socket and folder."""

    def bind() -> tuple[str, int, int]:
        path = socket_path(load(config))
        with contextlib.closing(_bind(path, 0o660)):
            return str(path), stat.S_IMODE(path.stat().st_mode), stat.S_IMODE(path.parent.stat().st_mode)

    return bind


def block_maker(config: Path) -> Callable[[], Any]:
    """Return a function that creates the file of the shared block and returns its mode."""

    def make() -> int:
        path = block_path(config.stem)
        os.close(create_file(path))
        return stat.S_IMODE(path.stat().st_mode)

    return make


def refusal(uid: int, function: Callable[[], Any], path: Path | str) -> str:
    """Return the message with which `function` fails as user `uid`; it names `path`, and its exit code is 69 or 77."""
    with pytest.raises(Raised) as caught:
        as_user(uid, function)
    assert caught.value.exit_code in (69, 77), caught.value.message
    assert str(path) in caught.value.message
    return caught.value.message


def folder_maker(folder: Path, mode: int = 0o777) -> Callable[[], None]:
    """Return a function that makes a folder with a mode."""

    def make() -> None:
        folder.mkdir()
        folder.chmod(mode)

    return make


def test_a_user_needs_no_folder_that_somebody_made(user_folder: Path, config: Path):
    assert as_user(VICTIM, runtime_folder) == user_folder
    assert as_user(VICTIM, socket_binder(config)) == (f"{user_folder}/{config.stem}.sock", 0o660, 0o750)
    assert as_user(VICTIM, block_maker(config)) == 0o600
    assert user_folder.stat().st_uid == VICTIM


@pytest.mark.parametrize("mode", [0o777, 0o755])
def test_a_folder_of_another_user_is_not_used(user_folder: Path, config: Path, mode: int):
    as_user(ATTACKER, folder_maker(user_folder, mode))
    for function in (socket_binder(config), block_maker(config)):
        assert f"user {ATTACKER}" in refusal(VICTIM, function, user_folder)
    assert os.listdir(user_folder) == []


def test_a_folder_that_others_may_write_is_not_used(user_folder: Path, config: Path):
    as_user(VICTIM, folder_maker(user_folder))
    for function in (socket_binder(config), block_maker(config)):
        assert "may write" in refusal(VICTIM, function, user_folder)


def test_a_link_of_another_user_leads_nowhere(user_folder: Path, config: Path):
    with contextlib.ExitStack() as stack:
        victim_folder = Path(f"/tmp/rtloop-own-{os.getpid()}")
        as_user(VICTIM, victim_folder.mkdir)
        stack.callback(victim_folder.rmdir)
        as_user(ATTACKER, lambda: user_folder.symlink_to(victim_folder))
        refusal(VICTIM, socket_binder(config), user_folder)
        assert os.listdir(victim_folder) == []


@contextlib.contextmanager
def forged_service(path: Path, uid: int) -> Iterator[None]:
    """Run a process of user `uid` that answers every request at the socket `path`."""
    answer = b'HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: 18\r\n\r\n{"by": "attacker"}'
    ready, done = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.setresgid(uid, uid, uid)
        os.setresuid(uid, uid, uid)
        listener = socket.socket(socket.AF_UNIX)
        listener.bind(str(path))
        os.chmod(path, 0o666)
        listener.listen()
        os.write(done, b"x")
        while True:
            connection, _ = listener.accept()
            with contextlib.suppress(OSError):
                connection.recv(1 << 16)
                connection.sendall(answer)
            connection.close()
    try:
        assert os.read(ready, 1) == b"x"
        yield
    finally:
        os.kill(pid, 9)
        os.waitpid(pid, 0)
        os.close(ready)
        os.close(done)
        path.unlink(missing_ok=True)


@pytest.mark.parametrize("owner", [ATTACKER, VICTIM])
def test_a_service_of_another_user_is_not_believed(user_folder: Path, owner: int):
    as_user(owner, folder_maker(user_folder))
    path = user_folder / "lab.sock"
    with forged_service(path, ATTACKER):
        refusal(VICTIM, lambda: Client(path).get("/status"), user_folder)
        refusal(VICTIM, lambda: next(iter(Client(path).watch())), user_folder)


def test_a_socket_with_another_owner_than_who_serves_it_is_not_believed(user_folder: Path):
    as_user(VICTIM, folder_maker(user_folder, 0o755))
    path = user_folder / "lab.sock"
    user_folder.chmod(0o777)
    with forged_service(path, ATTACKER):
        user_folder.chmod(0o755)
        os.chown(path, VICTIM, VICTIM)
        assert f"user ID {ATTACKER}" in refusal(VICTIM, lambda: Client(path).get("/status"), path)


def test_the_service_of_a_folder_that_root_gave_is_believed(tmp_path_factory: pytest.TempPathFactory):
    """A folder in /run that belongs to the service's user is trusted: only root can have created it for that user."""
    folder = Path(f"/run/rtloop-test-{os.getpid()}")
    folder.mkdir()
    try:
        os.chown(folder, ATTACKER, ATTACKER)
        with forged_service(folder / "lab.sock", ATTACKER):
            assert as_user(VICTIM, lambda: Client(folder / "lab.sock").get("/status")) == {"by": "attacker"}
    finally:
        folder.rmdir()


def test_the_group_of_the_folder_reaches_the_socket_of_root():
    folder = Path(f"/run/rtloop-test-{os.getpid()}")
    folder.mkdir(mode=0o750)
    try:
        os.chown(folder, 0, VICTIM)
        with contextlib.closing(_bind(folder / "lab.sock", 0o660)) as listener:

            def connect() -> None:
                with socket.socket(socket.AF_UNIX) as client:
                    client.connect(str(folder / "lab.sock"))

            as_user(VICTIM, connect)
            with pytest.raises(Raised, match="Permission"):
                as_user(ATTACKER, connect)
            listener.accept()[0].close()
    finally:
        (folder / "lab.sock").unlink(missing_ok=True)
        folder.rmdir()


def test_a_forged_block_parks_nothing(user_folder: Path, config: Path):
    as_user(ATTACKER, folder_maker(user_folder))

    def forge() -> None:
        fd = os.open(user_folder / f"{config.stem}.block", os.O_RDWR | os.O_CREAT, 0o666)
        SharedBlock.create(SIZES, fd)["last_drive_v"][0] = FORGED_V

    def park() -> str:
        parking.park = lambda *arguments: (_ for _ in ()).throw(AssertionError("an output moves"))  # type: ignore
        return parking.park_configuration(config)

    as_user(ATTACKER, forge)
    refusal(VICTIM, park, user_folder)


@pytest.mark.parametrize("kind", ["file", "link"])
def test_a_board_of_another_user_is_not_driven(kind: str):
    """Every user may create files in /dev/shm."""
    path = Path(f"/dev/shm/rtloop-test-{os.getpid()}")
    real = Path(f"/dev/shm/rtloop-test-real-{os.getpid()}")

    def make() -> None:
        file = path if kind == "file" else real
        file.touch()
        file.chmod(0o666)
        os.truncate(file, board.file_bytes())
        if kind == "link":
            path.symlink_to(file)

    def serve() -> None:
        board.serve(path, BoardOptions(), ["x"], 1000.0, lambda: True)

    def drive() -> None:
        ShmDriver(ShmOptions(file=str(path)), {"x": Wiring("adc0", "dac0")}, 1000.0).open()

    try:
        as_user(ATTACKER, make)
        for function in (serve, drive):
            with pytest.raises(Raised) as caught:
                as_user(VICTIM, function)
            # "Permission denied" comes from fs.protected_symlinks.
            allowed = (f"user {ATTACKER}", "symbolic link", "Permission denied")
            assert any(reason in caught.value.message for reason in allowed), caught.value.message
            assert caught.value.name in ("UntrustedPath", "DriverError", "OSError", "PermissionError")
    finally:
        path.unlink(missing_ok=True)
        real.unlink(missing_ok=True)


def test_compiled_code_is_loaded_from_a_folder_that_is_ours_up_to_the_root(user_folder: Path):
    def make_folders() -> list[bool]:
        user_folder.mkdir()
        (user_folder / "open").mkdir()
        (user_folder / "open").chmod(0o777)
        return [
            _make_private_folder(user_folder / "cache"),
            _make_private_folder(user_folder / "open" / "cache"),
            _make_private_folder(user_folder / "open"),
        ]

    assert as_user(VICTIM, make_folders) == [True, False, False]
    as_user(ATTACKER, lambda: (user_folder / "open" / "more").mkdir())
    assert as_user(VICTIM, lambda: _make_private_folder(user_folder / "open" / "more")) is False
