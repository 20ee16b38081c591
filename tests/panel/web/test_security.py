"""Access to the panel: clients without it, or with hostile requests, have no effect, and others are served meanwhile.

The panel has no service: a forwarded request has the status 503, a request that is not forwarded another one.
"""

from __future__ import annotations

import asyncio
import errno
import hashlib
import hmac
import http.client
import ipaddress
import json
import os
import re
import socket
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

from rtloop.errors import OutputError
from rtloop.panel.web.live import MAX_STREAMS
from rtloop.panel.web.rates import MAX_CLIENTS, ClientRateLimits, RateLimit, identify_client
from rtloop.panel.web.server import MAX_CONNECTIONS, own_address, serve, write_link
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.panel.route_server import exchange
from tests.panel.web.browser import Browser, unpack_message
from tests.users import ATTACKER, ROOT_ONLY, VICTIM, Raised, as_user

pytestmark = pytest.mark.system

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
    for host in (f"127.0.0.1:{browser.port}", "127.0.0.1:9000", "127.254.3.2"):  # The port and address of a tunnel.
        assert browser.request(*STOP, headers={"Host": host, "Origin": f"http://{host}"})[0] == FORWARDED, host
    assert browser.request(*STOP, headers={"Origin": None, "Sec-Fetch-Site": "same-origin"})[0] == FORWARDED


@pytest.mark.parametrize(
    ("host", "address"),
    [("localhost", "http://127.0.0.1/"), ("LOCALHOST:9000", "http://127.0.0.1:9000/"),
     ("[::1]:80", "http://127.0.0.1:80/")],
)  # fmt: skip
def test_the_page_by_name_leads_to_an_address_and_nothing_else_is_served_by_name(
    browser: Browser, host: str, address: str
):
    """Another user may listen on the same port of ::1, to which browsers take `localhost` first."""
    headers = {"Host": host, "Origin": f"http://{host}"}
    response = browser.request("GET", "/", headers=headers)
    assert (response.code, response.headers["location"]) == (307, address)
    for method, path in (STOP, ("GET", "/api/status"), ("POST", "/session"), ("GET", "/page/main.js")):
        assert browser.request(method, path, {"token": browser.token}, headers)[0] == REFUSED


@pytest.mark.parametrize(
    "host",
    ["evil.example", "127.0.0.1.evil.example", "localhost.evil.example:8321", "127.0.0.1@evil.example", "",
     "192.168.0.7", "evil.example#127.0.0.1", "127.0.0.1:x", "0.0.0.0:8321", "127.1", "2130706433", "127.0.0.1.",
     "localhost.:80", "[::ffff:127.0.0.1]"],
)  # fmt: skip
def test_other_hosts_are_refused(browser: Browser, host: str):
    for method, path in (STOP, ("GET", "/api/status"), ("GET", "/"), ("POST", "/session")):
        assert (
            browser.request(method, path, {"token": browser.token}, {"Host": host, "Origin": f"http://{host}"})[0]
            == 403
        )
        assert browser.request(method, path, {"token": browser.token}, {"Host": host, "Origin": None})[0] == REFUSED


def test_other_origins_are_refused(browser: Browser):
    panel = browser.origin
    origins = ["http://evil.example", "null", "", panel.replace("http", "https"), f"{panel}.evil.example", f"{panel}/"]
    origins += [f"http://localhost:{browser.port}", f"http://127.0.0.1:{browser.port}", f"http://{browser.host}"]
    origins.append(f"http://{browser.host}:{browser.port + 1}")
    for origin in origins:
        headers = {"Origin": origin, "Host": f"{browser.host}:{browser.port}"}
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
        assert browser.request("POST", path, body, {"Authorization": None})[0] == UNKNOWN
        assert browser.request("GET", path)[0] == 405
        assert browser.request("POST", path, body)[0] == FORWARDED


def test_requests_without_the_secret_are_refused(browser: Browser):
    secret = browser.session
    for text in (None, "", secret + "x", secret[:-1], f"Bearer {browser.token}", f"Bearer {secret}x", "Bearer ",
                 f"Basic {secret}", "x" * 9000, "\xff"):  # fmt: skip
        headers = {"Authorization": text, "Cookie": f"rtloop-{browser.port}={secret}; session={secret}"}
        for path in ("/api/status", "/api/panel", "/api/recordings", "/api/measure", "/live", f"/api/panel?x={secret}"):
            assert browser.request("GET", path, headers=headers)[0] == UNKNOWN, text
        assert browser.request(*STOP, headers=headers)[0] == UNKNOWN
    for offer in ("", secret + "x", browser.token):
        headers = {"Authorization": f"Bearer {secret}", "Cookie": f"rtloop-{browser.port}={secret}"}
        with pytest.raises((InvalidHandshake, EOFError, OSError)), browser.live(headers=headers, session=offer):
            pass
    assert browser.request("GET", "/", headers={"Authorization": None})[0] == 200
    assert browser.request("GET", "/page/../web/security.py", headers={"Authorization": None})[0] in (401, 404)
    assert browser.request("GET", "/page/%2e%2e/web/security.py", headers={"Authorization": None})[0] in (401, 404)
    assert browser.request("GET", f"/download/{secret}", headers={"Authorization": None})[0] == 404


def test_wrong_tokens_open_no_session(browser: Browser):
    tokens = [browser.token + "x", "", 7, None, "x" * 5000, "\ud800", browser.session]
    for body in (*({"token": token} for token in tokens), [], b"{", b"[" * 4000, b""):
        response = browser.request("POST", "/session", body, {"Authorization": None})
        assert (response.code, browser.session in response.body.decode()) == (UNKNOWN, False)
    response = browser.request("POST", "/session", {"token": browser.token}, {"Authorization": None})
    assert (response.json, "set-cookie" in response.headers) == ({"session": browser.session}, False)


def test_a_page_knows_its_panel_again_by_a_proof_that_does_not_contain_the_secret(browser: Browser):
    response = browser.request("GET", "/session?nonce=of+a+page", headers={"Authorization": None})
    expected = hmac.new(browser.session.encode(), b"of a page", hashlib.sha256).hexdigest()
    assert response.json == {"proof": expected}
    for query in ("", "?nonce=", f"?nonce={'x' * 101}"):
        assert browser.request("GET", f"/session{query}", headers={"Authorization": None})[0] == 422


def try_token(browser: Browser, token: str, source: str = "127.0.0.1") -> int:
    """Try to log in with a token from a loopback address `source`; return the status of the response."""
    connection = http.client.HTTPConnection(browser.host, browser.port, timeout=60, source_address=(source, 0))
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
    assert try_token(browser, browser.token, "127.0.0.3") == 200


@ROOT_ONLY
def test_guesses_of_another_user_lock_out_nobody_else(browser: Browser):
    """The two users send from the same address, as all clients on one host do."""
    assert as_user(ATTACKER, lambda: is_locked_out(browser, "127.0.0.4"))
    assert try_token(browser, browser.token, "127.0.0.4") == 200


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
    kernels = bytes(reversed([int(part) for part in browser.host.split(".")])).hex()
    listening = re.findall(rf"(\w+):{browser.port:04x} 00000000:0000 0a", Path("/proc/net/tcp").read_text().lower())
    assert kernels in listening
    assert "00000000" not in listening


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
        connections = [stack.enter_context(socket.create_connection((browser.host, browser.port))) for _ in range(200)]
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
        silent.connect((browser.host, browser.port))
        silent.send(
            f"GET /live HTTP/1.1\r\nHost: {browser.host}:{browser.port}\r\nOrigin: {browser.origin}\r\n"
            f"Sec-WebSocket-Protocol: rtloop, rtloop.session.{browser.session}\r\n"
            "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n".encode()
        )
        for message in other_live:
            if unpack_message(message)[0]["unix_s"] > 0:
                break
        for _ in range(40):
            browser.next_message(other_live, "state")
    assert resident_mib(browser) < before_mib + 64


def test_each_panel_has_an_address_and_a_file_of_its_own(tmp_path: Path):
    """Another user who knew the address before could have stored a service worker for it in the browser."""
    addresses = [ipaddress.IPv4Address(own_address()) for _ in range(200)]
    assert len(set(addresses)) > 190
    assert all(address in ipaddress.IPv4Network("127.0.0.0/8") for address in addresses)
    for link in ("http://127.1.2.3:8321/#token=one", "http://127.3.2.1:8321/#token=two"):
        write_link(tmp_path / "link", link)
        assert (tmp_path / "link").read_text() == f"{link}\n"
        assert stat.S_IMODE((tmp_path / "link").stat().st_mode) == 0o640
    with pytest.raises(OutputError, match="cannot write"):
        write_link(tmp_path / "no" / "link", "x")


def test_with_a_file_for_the_token_it_is_printed_nowhere(tmp_path: Path):
    bench, file = Bench(tmp_path), tmp_path / "link"
    (tmp_path / "log").touch()
    try:
        bench.rtloop("panel", tmp_path / "none.sock", "--port", "0", "--address", "127.0.0.1", "--token-file", file)
        address = wait_for(lambda: re.search(r"panel: (http://127\.0\.0\.1:\d+/) ", bench.log()), "a panel", 120)
        link, _, token = file.read_text().strip().partition("#token=")
        assert link == address[1]
        assert token not in bench.log()
        port = int(address[1].split(":")[2].strip("/"))
        assert exchange(port, "POST", "/session", {"token": token}, {"Origin": link.strip("/")}).code == 200
    finally:
        bench.__exit__()


def test_the_browser_gets_the_token_from_a_private_file_and_not_on_its_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    opened: list[str] = []

    def open_browser(url: str) -> None:
        file = Path(url.removeprefix("file://"))
        assert [stat.S_IMODE(path.stat().st_mode) for path in (file, file.parent)] == [0o600, 0o700]
        opened.extend((url, file.read_text()))

    monkeypatch.setattr("webbrowser.open", open_browser)
    monkeypatch.setattr("uvicorn.Server.serve", lambda *_, **__: asyncio.sleep(0))
    monkeypatch.setattr("os.nice", lambda _: 0)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    printed: list[str] = []
    assert serve(tmp_path / "none.sock", 0, None, printed.append, True) == 0
    url, text = opened
    assert "token" not in url
    assert f"url={printed[0]}" in text
    assert not Path(url.removeprefix("file://")).exists()


def test_a_disk_that_was_full_leaves_no_file_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fail_to_write(_fd: int, _data: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", fail_to_write)
        with pytest.raises(OutputError, match="No space left"):
            write_link(tmp_path / "link", "x")
    assert not (tmp_path / "link").exists()


@ROOT_ONLY
def test_a_file_of_another_user_is_not_written():
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o1777)
        as_user(ATTACKER, lambda: (folder / "known").write_text("old") and (folder / "known").chmod(0o666))
        as_user(ATTACKER, lambda: (folder / "link").symlink_to(folder / "known"))
        as_user(ATTACKER, lambda: os.mkfifo(folder / "pipe", 0o666))
        for file in ("known", "link", "pipe"):
            with pytest.raises(Raised) as caught:
                as_user(VICTIM, lambda file=file: write_link(folder / file, "secret"))
            assert caught.value.exit_code == 77, caught.value.message
            assert str(folder / file) in caught.value.message
        assert (folder / "known").read_text() == "old"


def test_a_rate_limit_allows_its_burst_and_its_rate():
    clock_s = [0.0]
    rate = RateLimit(10.0, 3, lambda: clock_s[0])
    assert [rate.allows() for _ in range(5)] == [True] * 3 + [False] * 2
    clock_s[0] = 0.25
    assert [rate.allows() for _ in range(4)] == [True] * 2 + [False] * 2
