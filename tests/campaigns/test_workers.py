"""Real worker processes: equal results for any number of workers, and after any process was killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import pytest

from rtloop import campaign as rtloop_campaign
from rtloop.campaigns.campaign_file import load_campaign
from rtloop.campaigns.unit import OtherVersion, WorkerFacts, run_unit
from tests.campaigns.campaign_files import result_files, rtloop, write_campaign
from tests.command_line import run
from tests.users import ROOT_ONLY

pytestmark = pytest.mark.system

KILLING_RIG = 7
DYING_WORKER_HOOK = f"""
import os, sys
if os.environ.get("KILLING"):
    import rtloop.campaigns.case as case
    run = case.CaseRunner.run
    def run_or_die(self, rig, values=None):
        if rig == {KILLING_RIG} and not os.path.exists(os.environ["KILLING"]):
            if os.environ.get("ONCE"):
                open(os.environ["KILLING"], "x").close()
            os.kill(os.getpid(), 11)
        return run(self, rig, values)
    case.CaseRunner.run = run_or_die
"""
"""A `sitecustomize`: one rig ends its worker by SIGSEGV; with ONCE, only until the file KILLING exists."""


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """A campaign of 60 rigs in units of 10."""
    return write_campaign(tmp_path_factory.mktemp("campaign"), keys="rigs = 60\nunit_rigs = 10")


@pytest.fixture(scope="module")
def expected(campaign):
    """The result files of the campaign, computed by one worker that is not disturbed: bytes by name."""
    process = rtloop("campaign", "run", campaign, "--jobs", 1, "--out", "one", folder=campaign.parent)
    _, errors = process.communicate(timeout=200)
    assert process.returncode == 1, errors  # some rigs fail
    return result_files(campaign.parent / "one")


def killing_environment(tmp_path: Path, once: bool) -> dict[str, str]:
    """Return the environment in which rig KILLING_RIG ends its worker: each time, or once."""
    (tmp_path / "sitecustomize.py").write_text(DYING_WORKER_HOOK)
    paths = [str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {
        "PYTHONPATH": os.pathsep.join(paths),
        "KILLING": str(tmp_path / "killed"),
        **({"ONCE": "1"} if once else {}),
    }


def test_two_workers_make_the_same_files(campaign, expected, tmp_path):
    process = rtloop("campaign", "run", campaign, "--jobs", 2, "--out", tmp_path / "two", folder=tmp_path)
    process.communicate(timeout=200)
    assert result_files(tmp_path / "two") == expected
    assert len(expected) == 8


@pytest.mark.soak
def test_further_rigs_leave_the_first_as_they_are(campaign, expected, tmp_path):
    for rigs in (25, 60):
        process = rtloop("campaign", "run", campaign, "--rigs", rigs, "--out", tmp_path / "more", folder=tmp_path)
        process.communicate(timeout=200)
    assert result_files(tmp_path / "more") == expected


def test_a_campaign_whose_coordinator_was_killed_continues(campaign, expected, tmp_path):
    folder = tmp_path / "killed"
    process = rtloop("campaign", "run", campaign, "--out", folder, folder=tmp_path)
    while not len(list(folder.glob("results/rigs-*.parquet"))) >= 2:
        assert process.poll() is None
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate(timeout=60)
    stored = {path.name: path.stat().st_ino for path in folder.glob("results/rigs-*.parquet")}
    process = rtloop("campaign", "run", campaign, "--out", folder, folder=tmp_path)
    process.communicate(timeout=200)
    assert result_files(folder) == expected
    assert {name: (folder / "results" / name).stat().st_ino for name in stored} == stored  # no rig ran twice


@pytest.mark.soak
def test_ctrl_c_lets_the_units_end_and_the_same_command_continues(campaign, expected, tmp_path):
    folder = tmp_path / "stopped"
    process = rtloop("campaign", "run", campaign, "--out", folder, folder=tmp_path)
    while not list(folder.glob("results/rigs-*.parquet")):
        assert process.poll() is None
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=100)
    assert process.returncode in (130, 1)  # 1: all rigs had run
    assert "Traceback" not in errors
    process = rtloop("campaign", "run", campaign, "--out", folder, folder=tmp_path)
    process.communicate(timeout=200)
    assert result_files(folder) == expected


def test_a_worker_that_dies_once_costs_nothing(campaign, expected, tmp_path):
    process = rtloop(
        "campaign",
        "run",
        campaign,
        "--jobs",
        2,
        "--out",
        "results",
        folder=tmp_path,
        environment=killing_environment(tmp_path, True),
    )
    _, errors = process.communicate(timeout=200)
    assert (tmp_path / "killed").exists(), errors
    assert result_files(tmp_path / "results") == expected


def test_a_rig_that_kills_its_worker_each_time_is_set_aside_and_no_other(campaign, expected, tmp_path):
    process = rtloop(
        "campaign", "run", campaign, "--jobs", 2, "--out", "results", "--json",
        folder=tmp_path, environment=killing_environment(tmp_path, False),
    )  # fmt: skip
    output, errors = process.communicate(timeout=200)
    summary = json.loads(output)
    assert summary["crashed"] == [KILLING_RIG], errors
    assert summary["counts"]["crashed"] == 1
    assert summary["yield_of_rigs"]["rigs"] == 60
    files = result_files(tmp_path / "results")
    assert [name for name in expected if files[name] != expected[name]] == ["rigs-000000001-000000010.parquet"]
    assert process.returncode == 1


def test_a_rig_repeats_with_equal_bytes(campaign, expected, tmp_path):
    folder = campaign.parent / "one"
    process = rtloop("campaign", "rerun", campaign, 12, "--out", folder, "--json", folder=tmp_path)
    output, errors = process.communicate(timeout=100)
    assert (process.returncode, json.loads(output)["equal"]) == (0, True), errors
    assert result_files(folder) == expected


def test_a_worker_of_another_version_is_refused_by_name(campaign):
    facts = WorkerFacts.of_this_process()
    other_versions = tuple((name, "0.0.1" if name == "numpy" else number) for name, number in facts.versions)
    with pytest.raises(
        OtherVersion, match=r"this worker has numpy [\d.]+, the coordinator 0\.0\.1; install equal versions"
    ):
        run_unit(load_campaign(campaign), [1], replace(facts, versions=other_versions))


@ROOT_ONLY
@pytest.mark.soak
def test_a_full_disk_loses_no_result_and_the_same_command_continues(campaign, expected, tmp_path):
    """A disk of 40 KiB has room for the first units only."""
    disk, folder = tmp_path / "disk", tmp_path / "disk/results"
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=40k", "tmpfs", str(disk)], check=True)
    try:
        process = rtloop("campaign", "run", campaign, "--out", folder, folder=tmp_path)
        _, errors = process.communicate(timeout=100)
        assert process.returncode == 73, errors
        assert "No space left on device" in errors
        assert "Traceback" not in errors
        stored = result_files(folder)
        assert 2 <= len(stored) < len(expected)
        assert {name: expected[name] for name in stored} == stored
        subprocess.run(["mount", "-o", "remount,size=10m", str(disk)], check=True)
        rtloop("campaign", "run", campaign, "--out", folder, folder=tmp_path).communicate(timeout=200)
        assert result_files(folder) == expected
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["campaign", "run", "nothing.toml"], 66, "nothing.toml: No such file"),
        (["campaign", "report", "nothing"], 66, "nothing/campaign.json: No such file"),
        (
            ["campaign", "run", "stage.toml", "--scheduler", "tcp://127.0.0.1:1", "--jobs", "2"],
            2,
            "--jobs: not allowed",
        ),
        (["campaign", "rerun", "stage.toml", "61"], 2, "RIG: value is 61; allowed: 0 … 60"),
    ],
)
def test_a_mistake_of_the_command_line_is_named(campaign, arguments, code, message, monkeypatch):
    monkeypatch.chdir(campaign.parent)
    result = run(*arguments)
    assert (result.exit_code, message in result.stderr) == (code, True), result.output


def test_a_campaign_from_python_returns_the_rows_of_its_files(campaign, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    table = rtloop_campaign(campaign, rigs=30, jobs=1)
    repeated = rtloop_campaign(campaign, rigs=30, jobs=1, out="campaigns/stage-paper")
    assert list(table["rig"]) == list(range(31))
    assert table.equals(repeated)
    files = result_files(Path("campaigns/stage-paper"))
    assert {name: content for name, content in files.items() if name in expected} == {
        name: content for name, content in expected.items() if name in files
    }
    assert len(files) == 5
