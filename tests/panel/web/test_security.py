"""Access to the panel: clients without it, or with hostile requests, have no effect, and others are served meanwhile.

The panel has no service: a forwarded request has the status 503, a request that is not forwarded another one.
"""

from __future__ import annotations

import errno
import http.client
import json
import os
import socket
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

import pytest
from starlette.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

from rtloop.errors import HostRefusal, OutputError
from rtloop.panel.web.live import MAX_STREAMS
from rtloop.panel.web.rates import MAX_CLIENTS, ClientRateLimits, RateLimit, identify_client
from rtloop.panel.web.security import MAX_SESSIONS, Sessions, host_name
from rtloop.panel.web.server import MAX_CONNECTIONS, read_or_make_token
from tests.faults.bench import Bench
from tests.panel.web.browser import Browser, unpack_message
from tests.users import ATTACKER, ROOT_ONLY, VICTIM, Raised, as_user

STOP = ("POST", "/api/stop")
FORWARDED, REFUSED, UNKNOWN = 503, 403, 401


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Yield a logged-in browser of a panel without a service."""
    folder = tmp_path_factory.mktemp("panel")
    (folder / "run").mkdir(mode=0o700)
    bench = Bench(folder)
    try:
        yield Browser(bench).log_in()
    finally:
        bench.__exit__()


def open_file_count(browser: Browser) -> int:
    """Return the number of open files of the panel."""
    return len(os.listdir(f"/proc/{browser.process.pid}/fd"))


def resident_mib(browser: Browser) -> float:
    """Return the resident memory of the panel, in MiB."""
    fields = Path(f"/proc/{browser.process.pid}/statm").read_text().split()
    return int(fields[1]) * 4096 / 2**20


def test_pages_with_host_origin_and_session_are_admitted(browser: Browser):
    assert browser.request(*STOP)[0] == FORWARDED
    for host in ("localhost", f"localhost:{browser.port}", "127.0.0.1:9000", "LOCALHOST:9000", "[::1]:80"):
        assert browser.request(*STOP, headers={"Host": host, "Origin": f"http://{host}"})[0] == FORWARDED, host
    assert browser.request(*STOP, headers={"Origin": None, "Sec-Fetch-Site": "same-origin"})[0] == FORWARDED


@pytest.mark.parametrize(
    "host",
    ["evil.example", "127.0.0.1.evil.example", "localhost.evil.example:8321", "127.0.0.1@evil.example", "",
     "192.168.0.7", "evil.example#127.0.0.1", "127.0.0.1:x", "0.0.0.0:8321", "127.1"],
)  # fmt: skip
def test_other_hosts_are_refused(browser: Browser, host: str):
    for method, path in (STOP, ("GET", "/api/status"), ("GET", "/"), ("POST", "/session")):
        assert (
            browser.request(method, path, {"token": browser.token}, {"Host": host, "Origin": f"http://{host}"})[0]
            == 403
        )
        assert browser.request(method, path, {"token": browser.token}, {"Host": host, "Origin": None})[0] == REFUSED
    assert host_name(host) not in ("127.0.0.1", "localhost", "::1")


def test_other_origins_are_refused(browser: Browser):
    panel = f"http://127.0.0.1:{browser.port}"
    origins = ["http://evil.example", "null", "", panel.replace("http", "https"), f"{panel}.evil.example", f"{panel}/"]
    origins += [panel.replace("127.0.0.1", "localhost"), "http://127.0.0.1", f"http://127.0.0.1:{browser.port + 1}"]
    for origin in origins:
        headers = {"Origin": origin, "Host": f"127.0.0.1:{browser.port}"}
        for method, path in (STOP, ("DELETE", "/api/lock"), ("POST", "/session"), ("GET", "/api/status")):
            assert browser.request(method, path, {"token": browser.token}, headers)[0] == REFUSED, origin
        with pytest.raises(InvalidStatus, match=r"40[03]"), browser.live(headers=headers):
            pass


def test_requests_without_an_origin_are_refused(browser: Browser):
    for site in (None, "cross-site", "same-site", "none"):
        headers = {"Origin": None, "Sec-Fetch-Site": site}
        assert browser.request(*STOP, headers=headers)[0] == REFUSED
        assert browser.request("DELETE", "/api/lock", headers=headers)[0] == REFUSED


def test_measurements_and_swaps_are_for_pages_with_a_session_alone(browser: Browser):
    row = {"taps": [1.0], "command_taps": [0.0]}
    bodies = {"swap": {"axis": "x", "replaces": row, "prefilter": row}}
    for name in ("response", "learn", "retune", "swap"):
        body = bodies.get(name, {"axis": "x"})
        path = f"/api/{name}?as=ada"
        assert browser.request("POST", path, body, {"Origin": "http://evil.example"})[0] == REFUSED
        assert browser.request("POST", path, body, {"Origin": None})[0] == REFUSED
        assert browser.request("POST", path, body, {"Cookie": None})[0] == UNKNOWN
        assert browser.request("GET", path)[0] == 405
        assert browser.request("POST", path, body)[0] == FORWARDED


def test_requests_without_a_valid_session_are_refused(browser: Browser):
    name, _, session = browser.cookie.partition("=")
    for cookie in (None, "", f"{name}=", f"{name}=x", f"other={session}", f"{name}={session}x", f"{name}={'x' * 9000}",
                   "\x01=;;;=,", f"rtloop-1={session}"):  # fmt: skip
        headers = {"Cookie": cookie}
        for path in ("/api/status", "/api/panel", "/api/recordings", "/api/measure", "/live"):
            assert browser.request("GET", path, headers=headers)[0] == UNKNOWN, cookie
        assert browser.request(*STOP, headers=headers)[0] == UNKNOWN
        refused = (InvalidHandshake, EOFError, OSError)
        with pytest.raises(refused), browser.live(headers={"Cookie": cookie or "none=1"}):
            pass
    assert browser.request("GET", "/", headers={"Cookie": None})[0] == 200
    assert browser.request("GET", "/page/../web/security.py", headers={"Cookie": None})[0] in (401, 404)
    assert browser.request("GET", "/page/%2e%2e/web/security.py", headers={"Cookie": None})[0] in (401, 404)


def test_wrong_tokens_open_no_session(browser: Browser):
    tokens = [browser.token + "x", "", 7, None, "x" * 5000, "\ud800"]
    for body in (*({"token": token} for token in tokens), [], b"{", b"[" * 4000, b""):
        status, headers, _ = browser.request("POST", "/session", body, {"Cookie": None})
        assert (status, "set-cookie" in headers) == (UNKNOWN, False)
    status, headers, _ = browser.request("POST", "/session", {"token": browser.token}, {"Cookie": None})
    cookie = headers["set-cookie"].lower()
    assert status == 204
    assert all(word in cookie for word in ("httponly", "samesite=strict", "path=/"))


def try_token(browser: Browser, token: str, source: str = "127.0.0.1") -> int:
    """Try to log in with a token from a loopback address `source`; return the status of the response."""
    connection = http.client.HTTPConnection("127.0.0.1", browser.port, timeout=60, source_address=(source, 0))
    with closing(connection):
        connection.request("POST", "/session", json.dumps({"token": token}), {"Origin": browser.origin})
        return connection.getresponse().status


def is_locked_out(browser: Browser, source: str) -> bool:
    """Try 60 wrong tokens; return whether some of them, and then the right token, are refused with 429.

    The panel allows another try every 0.2 s; where the host stalls for so long, all is tried again, five times at most.
    """
    codes = set[int]()
    for _ in range(5):
        codes |= {try_token(browser, "guess", source) for _ in range(60)}
        if try_token(browser, browser.token, source) == 429:
            return codes == {401, 429}
    return False


def test_guesses_lock_out_the_client_that_makes_them_alone(browser: Browser):
    assert is_locked_out(browser, "127.0.0.2")
    assert try_token(browser, browser.token, "127.0.0.3") == 204


@ROOT_ONLY
def test_guesses_of_another_user_lock_out_nobody_else(browser: Browser):
    """The two users send from the same address, as all clients on one host do."""
    assert as_user(ATTACKER, lambda: is_locked_out(browser, "127.0.0.4"))
    assert try_token(browser, browser.token, "127.0.0.4") == 204


def test_the_newest_sessions_are_kept():
    sessions = Sessions("token", 1)
    opened = [sessions.open_session("token") for _ in range(MAX_SESSIONS + 1)]
    is_valid = [sessions.has_session(Headers({"cookie": f"{sessions.cookie}={session}"})) for session in opened]
    assert is_valid == [False] + [True] * MAX_SESSIONS
    assert len(set(opened)) == MAX_SESSIONS + 1


def test_each_client_has_a_separate_rate_and_the_newest_are_kept():
    clock_s = [0.0]
    rates = ClientRateLimits(1.0, 2, lambda: clock_s[0])
    assert [rates.allows("one") for _ in range(3)] == [True, True, False]
    assert [rates.allows("two") for _ in range(3)] == [True, True, False]
    for number in range(10 * MAX_CLIENTS):
        rates.allows(number)
        rates.allows("one")  # The client that was seen last is not forgotten.
    assert len(rates) == MAX_CLIENTS
    assert not rates.allows("one")
    clock_s[0] = 1.0
    assert rates.allows("one")


def test_a_client_is_identified_by_address_and_user():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        with socket.create_connection(listener.getsockname(), source_address=("127.0.0.5", 0)) as client:
            scope = {"client": client.getsockname(), "server": listener.getsockname()}
            assert identify_client(scope) == ("127.0.0.5", os.geteuid())
        assert identify_client(scope) == ("127.0.0.5", None)
    assert identify_client({"client": None, "server": ("/run/rtloop/panel.sock", None)}) == ("", None)
    assert identify_client({"client": ("::1", 5), "server": ("::1", 6)}) == ("::1", None)


def test_pages_are_restricted_by_their_headers(browser: Browser):
    _, headers, _ = browser.request("GET", "/")
    policy = headers["content-security-policy"]
    assert policy.startswith("default-src 'self'")
    assert "unsafe" not in policy
    assert "frame-ancestors 'none'" in policy
    assert (headers["x-content-type-options"], headers["referrer-policy"]) == ("nosniff", "no-referrer")
    assert browser.request("GET", "/api/status")[1]["cache-control"] == "no-store"
    with socket.create_connection(("127.0.0.1", browser.port)) as connection:
        assert connection.getpeername()[0] == "127.0.0.1"
    listening = Path("/proc/net/tcp").read_text().lower()
    assert f"0100007f:{browser.port:04x} 00000000:0000 0a" in listening
    assert f"00000000:{browser.port:04x} 00000000:0000 0a" not in listening


def test_large_bodies_are_refused(browser: Browser):
    for path, size, code in (("setpoint", 1 << 17, 413), ("waveform", 1 << 17, 503), ("waveform", 5 << 20, 413),
                             ("learn", 1 << 17, 503), ("learn", 5 << 20, 413), ("retune", 1 << 17, 413)):  # fmt: skip
        try:
            assert browser.request("POST", f"/api/{path}", b"x" * size)[0] == code
        except (BrokenPipeError, ConnectionResetError):
            assert code == 413  # The panel closed the connection before the whole body was sent.
    assert browser.request("POST", "/api/exec", b"{}")[0] in (404, 405)


@pytest.mark.parametrize(
    "message",
    ["", "no json", "[" * 60_000, '{"view":' * 8000, '{"view": NaN}',
     '{"view": {"signals": [], "seconds": 1e308, "pixels": 1}}',
     '{"view": {"signals": ["x"], "seconds": 1, "pixels": 1e308}}', '{"spectrum": {"signal": 7}}', b"\x00\xff" * 100,
     '{"__init__": 1, "xy": []}', '{"view": {"trigger": {"trigger": {"trigger": {}}}}}', '{"\\ud800": "\\udfff"}'],
)  # fmt: skip
def test_malformed_messages_are_refused_and_the_stream_goes_on(browser: Browser, message: Any):
    with browser.live() as live:
        live.send(message)
        header, _ = browser.next_message(live, "refused")
        assert header["error"]
        assert browser.next_message(live, "state")[0]["state"] == "unreachable"


def test_a_message_that_is_too_large_ends_its_stream(browser: Browser):
    with browser.live() as live:
        live.send("x" * 70_000)
        with suppress(ConnectionClosed):
            for _ in live:
                pass
        assert live.close_code in (1009, 1006)


def test_two_hundred_connections_and_one_that_is_served(browser: Browser):
    before_mib, files_before = resident_mib(browser), open_file_count(browser)
    with ExitStack() as stack:
        connections = [stack.enter_context(socket.create_connection(("127.0.0.1", browser.port))) for _ in range(200)]
        for connection in connections[::2]:
            connection.send(b"POST /api/setpoint HTTP/1.1\r\nHost: localhost\r\nContent-Length: 60000\r\n\r\n{")
        assert browser.request(*STOP)[0] == FORWARDED
        assert browser.request("GET", "/")[0] == 200
        assert open_file_count(browser) - files_before < 2 * MAX_CONNECTIONS
    assert resident_mib(browser) < before_mib + 64


def test_streams_beyond_the_limit_are_refused(browser: Browser):
    with ExitStack() as stack:
        for _ in range(MAX_STREAMS):
            stack.enter_context(browser.live())
        with pytest.raises(InvalidStatus, match="403"), browser.live():
            pass
        assert browser.request(*STOP)[0] == FORWARDED
    deadline_s = time.monotonic() + 20
    while time.monotonic() < deadline_s:
        try:
            with browser.live() as live:
                browser.next_message(live, "state")
                return
        except InvalidStatus:
            time.sleep(0.1)
    raise AssertionError("the panel accepts no stream after the others were closed")


def test_a_flood_of_messages_is_read_slowly(browser: Browser):
    """The flood waits in the kernel's buffers, not in the panel's memory, and other clients are served."""
    before_mib = resident_mib(browser)
    with browser.live() as flood, browser.live() as other_live:
        flood.socket.settimeout(2.0)
        message = json.dumps({"view": {"signals": ["x" * 50] * 8, "seconds": 1, "pixels": 1}, "nothing": "x" * 50_000})
        try:
            for _ in range(300):
                flood.send(message)
        except (TimeoutError, ConnectionClosed, OSError):
            pass
        for _ in range(20):
            browser.next_message(other_live, "state")
    assert resident_mib(browser) < before_mib + 64


def test_a_client_that_never_reads_delays_no_other(browser: Browser):
    """Other clients are served meanwhile, and the panel buffers no frames for the client that never reads.

    `test_stream` proves that the panel drops such a client.
    """
    before_mib = resident_mib(browser)
    with socket.socket() as silent, browser.live() as other_live:
        silent.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        silent.connect(("127.0.0.1", browser.port))
        silent.send(
            f"GET /live HTTP/1.1\r\nHost: 127.0.0.1:{browser.port}\r\nOrigin: {browser.origin}\r\n"
            f"Cookie: {browser.cookie}\r\n"
            "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n".encode()
        )
        for message in other_live:
            if unpack_message(message)[0]["unix_s"] > 0:
                break
        for _ in range(40):
            browser.next_message(other_live, "state")
    assert resident_mib(browser) < before_mib + 64


def test_the_token_file_is_made_once_and_private(tmp_path: Path):
    token = read_or_make_token(tmp_path / "token")
    assert read_or_make_token(tmp_path / "token") == token
    assert stat.S_IMODE((tmp_path / "token").stat().st_mode) == 0o640
    assert len(token) >= 32
    assert read_or_make_token(tmp_path / "other") != token
    (tmp_path / "token").chmod(0o644)
    with pytest.raises(OutputError, match="other users may read or write"):
        read_or_make_token(tmp_path / "token")
    (tmp_path / "short").write_text("1234")
    (tmp_path / "short").chmod(0o600)
    with pytest.raises(OutputError, match="4 characters"):
        read_or_make_token(tmp_path / "short")
    with pytest.raises(OutputError, match="cannot create"):
        read_or_make_token(tmp_path / "no" / "token")


@ROOT_ONLY
def test_a_disk_that_was_full_leaves_no_token_file_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fail_to_write(_fd: int, _data: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", fail_to_write)
        with pytest.raises(OutputError, match="No space left"):
            read_or_make_token(tmp_path / "token")
    assert len(read_or_make_token(tmp_path / "token")) >= 32


def test_a_token_file_of_another_user_is_refused():
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o1777)
        attackers_file = folder / "known"
        as_user(ATTACKER, lambda: attackers_file.write_text("x" * 40) and attackers_file.chmod(0o640))
        as_user(ATTACKER, lambda: (folder / "link").symlink_to(attackers_file))
        os.chown(folder / "known", ATTACKER, VICTIM)  # The group lets the victim read the file.
        as_user(VICTIM, lambda: (folder / "group").write_text("x" * 40) and (folder / "group").chmod(0o660))
        for file in ("known", "link", "group"):
            with pytest.raises(Raised, match=r"token|link|user|write") as caught:
                as_user(VICTIM, lambda file=file: read_or_make_token(folder / file))
            assert caught.value.exit_code == 77, caught.value.message
            assert str(folder / file) in caught.value.message
        assert as_user(VICTIM, lambda: read_or_make_token(folder / "own")) == as_user(
            VICTIM, lambda: read_or_make_token(folder / "own")
        )


def test_a_token_file_must_not_be_a_pipe(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe", 0o600)
    with pytest.raises(HostRefusal, match="not a regular file"):
        read_or_make_token(tmp_path / "pipe")


def test_a_rate_limit_allows_its_burst_and_its_rate():
    clock_s = [0.0]
    rate = RateLimit(10.0, 3, lambda: clock_s[0])
    assert [rate.allows() for _ in range(5)] == [True] * 3 + [False] * 2
    clock_s[0] = 0.25
    assert [rate.allows() for _ in range(4)] == [True] * 2 + [False] * 2
