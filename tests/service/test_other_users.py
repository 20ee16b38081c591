"""Another user of the machine comes first: to the folder in /tmp, socket, block, board, compiled code."""

from __future__ import annotations

import contextlib
import os
import socket
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import rtloop.drivers.sim  # noqa: F401  (compiled where it is imported: not as a user who has no place for it)
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

pytestmark = [ROOT_ONLY, pytest.mark.skipif(os.stat("/tmp").st_mode & 0o1777 != 0o1777, reason="/tmp is not shared")]
SIZES = Sizes(columns=1, axes=1, rate_hz=1000.0, snapshot_bytes=8, table_samples=1)
FORGED_V = 9.9


@pytest.fixture
def place() -> Iterator[Path]:
    """The victim's folder in /tmp, not there yet."""
    with clean_places() as folder:
        yield folder


@pytest.fixture
def config(place: Path) -> Iterator[Path]:
    """The paper's configuration where everybody may read it."""
    path = Path(f"/tmp/rtloop-test-{os.getpid()}.toml")
    path.write_text(PAPER.read_text())
    yield path
    path.unlink()


def bound(config: Path) -> Callable[[], Any]:
    def bind() -> tuple[str, int, int]:
        path = socket_path(load(config))
        with contextlib.closing(_bind(path, 0o660)):
            return str(path), stat.S_IMODE(path.stat().st_mode), stat.S_IMODE(path.parent.stat().st_mode)

    return bind


def blocked(config: Path) -> Callable[[], Any]:
    def make() -> int:
        path = block_path(config.stem)
        os.close(create_file(path))
        return stat.S_IMODE(path.stat().st_mode)

    return make


def refused(uid: int, function: Callable[[], Any], place: Path | str) -> str:
    """The message with which it is refused, at the exit code of what the host does not allow."""
    with pytest.raises(Raised) as caught:
        as_user(uid, function)
    assert caught.value.exit_code in (69, 77), caught.value.message
    assert str(place) in caught.value.message
    return caught.value.message


def occupy(place: Path, mode: int = 0o777) -> Callable[[], None]:
    def make() -> None:
        place.mkdir()
        place.chmod(mode)

    return make


def test_a_user_needs_no_folder_that_somebody_made(place: Path, config: Path):
    assert as_user(VICTIM, runtime_folder) == place
    assert as_user(VICTIM, bound(config)) == (f"{place}/{config.stem}.sock", 0o660, 0o750)
    assert as_user(VICTIM, blocked(config)) == 0o600
    assert place.stat().st_uid == VICTIM


@pytest.mark.parametrize("mode", [0o777, 0o755])
def test_a_folder_of_another_user_is_not_used(place: Path, config: Path, mode: int):
    as_user(ATTACKER, occupy(place, mode))
    for function in (bound(config), blocked(config)):
        assert f"user {ATTACKER}" in refused(VICTIM, function, place)
    assert os.listdir(place) == []


def test_a_folder_that_others_may_write_is_not_used(place: Path, config: Path):
    as_user(VICTIM, occupy(place))
    for function in (bound(config), blocked(config)):
        assert "may write" in refused(VICTIM, function, place)


def test_a_link_of_another_user_leads_nowhere(place: Path, config: Path):
    with contextlib.ExitStack() as stack:
        own = Path(f"/tmp/rtloop-own-{os.getpid()}")
        as_user(VICTIM, own.mkdir)
        stack.callback(own.rmdir)
        as_user(ATTACKER, lambda: place.symlink_to(own))
        refused(VICTIM, bound(config), place)
        assert os.listdir(own) == []


@contextlib.contextmanager
def served(path: Path, uid: int) -> Iterator[None]:
    """Somebody of this user who answers everything at `path`."""
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


@pytest.mark.parametrize("maker", [ATTACKER, VICTIM])
def test_a_service_of_another_user_is_not_believed(place: Path, maker: int):
    as_user(maker, occupy(place))
    path = place / "lab.sock"
    with served(path, ATTACKER):
        refused(VICTIM, lambda: Client(path).get("/status"), place)
        refused(VICTIM, lambda: next(iter(Client(path).watch())), place)


def test_a_socket_with_another_owner_than_who_serves_it_is_not_believed(place: Path):
    as_user(VICTIM, occupy(place, 0o755))
    path = place / "lab.sock"
    place.chmod(0o777)
    with served(path, ATTACKER):
        place.chmod(0o755)
        os.chown(path, VICTIM, VICTIM)
        assert f"user ID {ATTACKER}" in refused(VICTIM, lambda: Client(path).get("/status"), path)


def test_the_service_of_a_folder_that_root_gave_is_believed(tmp_path_factory: pytest.TempPathFactory):
    """As /run/rtloop is the service user's: root alone can have given it to him."""
    folder = Path(f"/run/rtloop-test-{os.getpid()}")
    folder.mkdir()
    try:
        os.chown(folder, ATTACKER, ATTACKER)
        with served(folder / "lab.sock", ATTACKER):
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


def test_a_forged_block_parks_nothing(place: Path, config: Path):
    as_user(ATTACKER, occupy(place))

    def forge() -> None:
        fd = os.open(place / f"{config.stem}.block", os.O_RDWR | os.O_CREAT, 0o666)
        SharedBlock.create(SIZES, fd)["last_drive_v"][0] = FORGED_V

    def park() -> str:
        parking.park = lambda *arguments: (_ for _ in ()).throw(AssertionError("an output moves"))  # type: ignore
        return parking.park_configuration(config)

    as_user(ATTACKER, forge)
    refused(VICTIM, park, place)


@pytest.mark.parametrize("kind", ["file", "link"])
def test_a_board_of_another_user_is_not_driven(kind: str):
    """In /dev/shm everybody may make files."""
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
            # the last from fs.protected_symlinks
            allowed = (f"user {ATTACKER}", "symbolic link", "Permission denied")
            assert any(reason in caught.value.message for reason in allowed), caught.value.message
            assert caught.value.name in ("UntrustedPath", "DriverError", "OSError", "PermissionError")
    finally:
        path.unlink(missing_ok=True)
        real.unlink(missing_ok=True)


def test_compiled_code_is_loaded_from_a_folder_that_is_ours_up_to_the_root(place: Path):
    def made() -> list[bool]:
        place.mkdir()
        (place / "open").mkdir()
        (place / "open").chmod(0o777)
        return [
            _make_private_folder(place / "cache"),
            _make_private_folder(place / "open" / "cache"),
            _make_private_folder(place / "open"),
        ]

    assert as_user(VICTIM, made) == [True, False, False]
    as_user(ATTACKER, lambda: (place / "open" / "more").mkdir())
    assert as_user(VICTIM, lambda: _make_private_folder(place / "open" / "more")) is False
