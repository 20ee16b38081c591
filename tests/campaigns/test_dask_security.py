"""Dask's connections: what other hosts may reach is named, and a missing certificate is an error in one sentence."""

from __future__ import annotations

from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner

from rtloop.campaigns.workers import DaskWorkers
from rtloop.cli import main
from tests.campaigns.campaign_files import write_campaign

pytestmark = pytest.mark.skipif(find_spec("distributed") is None, reason="distributed is not installed")


def warnings(scheduler: str, *workers: str) -> list[str]:
    """Return the warnings for a scheduler and workers at these addresses."""
    client = SimpleNamespace(scheduler_info=lambda: {"address": scheduler}, nthreads=lambda: dict.fromkeys(workers, 1))
    cluster: Any = SimpleNamespace(_client=client)
    return DaskWorkers.warnings(cluster)


@pytest.mark.parametrize(
    "addresses",
    [
        ("tcp://127.0.0.1:8786", "tcp://127.9.9.9:40000"),
        ("tcp://[::1]:8786", "tcp://localhost:40000"),
        ("tls://192.168.7.2:8786", "tls://192.168.7.3:40000"),
        ("inproc://192.168.7.2/5/1",),
    ],
)
def test_addresses_of_this_host_and_with_certificates_bring_no_warning(addresses: tuple[str, ...]):
    assert warnings(*addresses) == []


@pytest.mark.parametrize(
    ("addresses", "words"),
    [
        (("tcp://192.168.7.2:8786", "tcp://127.0.0.1:40000"), "tcp://192.168.7.2:8786: open"),
        (("tcp://127.0.0.1:8786", "tcp://192.168.7.2:40000"), "tcp://192.168.7.2:40000: open"),
        (("tcp://lab-pc:8786", "tcp://[fe80::1]:1", "ws://10.0.0.1:2"), "tcp://lab-pc:8786 and 2 more addresses: open"),
        (("tcp://0.0.0.0:8786",), "tcp://0.0.0.0:8786: open"),
    ],
)
def test_addresses_that_other_hosts_reach_are_named(addresses: tuple[str, ...], words: str):
    (warning,) = warnings(*addresses)
    assert words in warning
    assert "run any program as the user of the scheduler, of its workers and of this command" in warning


@pytest.mark.parametrize(
    ("scheme", "settings", "words"),
    [
        ("tls", {}, "Dask has no certificate here; set distributed.comm.tls"),
        ("tls", {"ca-file": "/nowhere", "client.cert": "/nowhere"}, "certificate cannot be read"),
        ("tcp", {"require-encryption": True}, "Dask's configuration requires TLS; allowed: tls://HOST:PORT"),
    ],
)
def test_a_scheduler_without_the_certificate_that_it_needs_is_refused(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch, scheme: str, settings: dict[str, Any], words: str
):
    import dask.config

    names = {name: f"distributed.comm.{'' if name == 'require-encryption' else 'tls.'}{name}" for name in settings}
    monkeypatch.setattr("rtloop.campaigns.workers._require_reachable", lambda _: None)
    with dask.config.set({names[name]: value for name, value in settings.items()}):
        address = f"{scheme}://127.0.0.1:8786"
        result = CliRunner().invoke(main, ["campaign", "run", str(write_campaign(tmp_path)), "--scheduler", address])
    assert (result.exit_code, words in result.output) == (69, True), result.output
