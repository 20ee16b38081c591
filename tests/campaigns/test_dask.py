"""A real Dask scheduler with real workers: the same files, and no lost result when one of these processes is killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from importlib.util import find_spec

import pytest

from tests.campaigns.bad_recordings import dask_cluster
from tests.campaigns.campaign_files import result_files, rtloop, write_campaign
from tests.campaigns.test_workers import KILLING_RIG, killing_environment

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(find_spec("distributed") is None, reason="distributed is not installed"),
]


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """A campaign of 200 rigs in units of 5."""
    return write_campaign(tmp_path_factory.mktemp("campaign"), keys="rigs = 200\nunit_rigs = 5")


@pytest.fixture(scope="module")
def expected(campaign):
    """The result files of the campaign, computed by local worker processes: bytes by name."""
    process = rtloop("campaign", "run", campaign, "--out", "one", folder=campaign.parent)
    process.communicate(timeout=200)
    return result_files(campaign.parent / "one")


def run_and_disturb(campaign, folder, address, disturb, tmp_path):
    """Run a campaign on a scheduler, and call `disturb` after four results. Returns exit code and stderr."""
    process = rtloop("campaign", "run", campaign, "--scheduler", address, "--out", folder, folder=tmp_path)
    while len(list(folder.glob("results/rigs-*.parquet"))) < 4:
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    disturb()
    _, errors = process.communicate(timeout=200)
    return process.returncode, errors


def test_dask_workers_make_the_same_files(tmp_path):
    small_campaign = write_campaign(tmp_path, keys="rigs = 40\nunit_rigs = 5")
    with dask_cluster(tmp_path, 2) as address:
        process = rtloop(
            "campaign", "run", small_campaign, "--scheduler", address, "--out", tmp_path / "a", folder=tmp_path
        )
        _, errors = process.communicate(timeout=200)
    rtloop("campaign", "run", small_campaign, "--out", tmp_path / "one", folder=tmp_path).communicate(timeout=200)
    assert result_files(tmp_path / "a") == result_files(tmp_path / "one"), errors


@pytest.mark.soak
def test_a_dask_worker_that_is_killed_costs_nothing(campaign, expected, tmp_path):
    """A worker is killed during its work; its nanny process starts another worker."""
    with dask_cluster(tmp_path, 2) as address:
        worker = _process_ids(address, "print(*c.run(os.getpid).values())")[0]
        kill = partial(os.kill, worker, signal.SIGKILL)
        code, errors = run_and_disturb(campaign, tmp_path / "b", address, kill, tmp_path)
        assert code == 1, errors
        assert result_files(tmp_path / "b") == expected


def _process_ids(address: str, statement: str) -> list[int]:
    """Run a statement that prints process ids, with `c` as a client of a scheduler. Returns these ids."""
    script = f"import os, sys; from distributed import Client; c = Client(sys.argv[1], timeout=20); {statement}"
    output = subprocess.run([sys.executable, "-c", script, address], capture_output=True, text=True, check=True).stdout
    return [int(number) for number in output.split()]


@pytest.mark.soak
def test_a_campaign_whose_scheduler_was_killed_continues_elsewhere(campaign, expected, tmp_path):
    folder = tmp_path / "results"
    with dask_cluster(tmp_path, 2) as address:
        (scheduler,) = _process_ids(address, "print(c.run_on_scheduler(os.getpid))")
        code, errors = run_and_disturb(campaign, folder, address, lambda: os.kill(scheduler, signal.SIGKILL), tmp_path)
    assert code == 69, errors
    assert "the connection to the scheduler is lost; run the same command again to continue" in errors
    assert "Traceback" not in errors, errors
    stored = {path.name: path.stat().st_ino for path in folder.glob("results/rigs-*.parquet")}
    process = rtloop("campaign", "run", campaign, "--out", folder, folder=tmp_path)
    process.communicate(timeout=200)
    assert result_files(folder) == expected
    assert {name: (folder / "results" / name).stat().st_ino for name in stored} == stored


@pytest.mark.soak
def test_a_rig_that_kills_its_dask_worker_each_time_is_set_aside_and_no_other(
    campaign, expected, tmp_path, monkeypatch
):
    """Dask starts the rig in several workers before it gives up."""
    for name, value in killing_environment(tmp_path, False).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "0")
    with dask_cluster(tmp_path, 2) as address:
        process = rtloop(
            "campaign", "run", campaign, "--scheduler", address, "--out", "results", "--json", folder=tmp_path
        )
        output, errors = process.communicate(timeout=250)
    assert json.loads(output)["crashed"] == [KILLING_RIG], errors
    files = result_files(tmp_path / "results")
    assert [name for name in expected if files[name] != expected[name]] == ["rigs-000000006-000000010.parquet"]


@pytest.mark.soak
def test_a_worker_without_the_package_is_named(campaign, tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text(
        "import os, sys\nif os.environ.get('WITHOUT_RTLOOP'):\n    sys.modules['rtloop'] = None\n"
    )
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("WITHOUT_RTLOOP", "1")
    with dask_cluster(tmp_path, 1) as address:
        monkeypatch.delenv("WITHOUT_RTLOOP")
        process = rtloop("campaign", "run", campaign, "--scheduler", address, folder=tmp_path)
        _, errors = process.communicate(timeout=100)
    assert process.returncode == 69, errors
    assert "the scheduler has no rtloop (" in errors
    assert errors.count("has no rtloop") == 2
    assert "Traceback" not in errors


OUT_OF_REACH = {
    "tcp://127.0.0.1:1": "scheduler tcp://127.0.0.1:1: Connection refused; start it",
    "nonsense://x": "scheduler: nonsense://x; allowed: tcp://HOST:PORT",
    "tcp://127.0.0.1:99999": "scheduler tcp://127.0.0.1:99999: ",
    "tcp://no-such-host:8786": "scheduler tcp://no-such-host:8786: ",
}
CALL_EACH_SCHEDULER = """
import sys
from rtloop.cli import main
campaign, *addresses = sys.argv[1:]
for address in addresses:
    print("=", address, file=sys.stderr)
    try:
        main(["campaign", "run", campaign, "--scheduler", address])
    except SystemExit as end:
        print("exit", end.code, file=sys.stderr)
"""
"""Program that runs the campaign on each scheduler, in one process, as the import of Dask is slow."""


def test_a_scheduler_that_cannot_be_reached_is_named(campaign, tmp_path):
    command = [sys.executable, "-c", CALL_EACH_SCHEDULER, str(campaign), *OUT_OF_REACH]
    process = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=200, check=True)
    messages = {text.split()[0]: text for text in process.stderr.split("= ")[1:]}
    assert messages.keys() == OUT_OF_REACH.keys()
    for address, text in messages.items():
        assert (OUT_OF_REACH[address] in text, "exit 69" in text, "Traceback" in text) == (True, True, False), text


@pytest.mark.soak
def test_a_scheduler_without_a_worker_is_named(campaign, tmp_path):
    with dask_cluster(tmp_path, 0) as address:
        process = rtloop("campaign", "run", campaign, "--scheduler", address, folder=tmp_path)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 69
    assert "no worker is connected; start `dask worker ADDRESS --host 127.0.0.1" in errors
