"""The store of results: no rig is lost or counted twice, whatever order, damage or kill its files met."""

from __future__ import annotations

import errno
import math
import os
from pathlib import Path

import pyarrow.parquet
import pytest

from rtloop.campaigns.campaign_file import load_campaign
from rtloop.campaigns.case import CaseRunner
from rtloop.campaigns.store import DAMAGED, crashed_case, open_store
from rtloop.campaigns.summary import summarise_campaign
from rtloop.campaigns.unit import Unit, split_into_units
from rtloop.configuration.text_files import InputFileError
from rtloop.errors import ConfigError, OutputError, UnavailableError
from tests.campaigns.campaign_files import STEPS, result_files, write_campaign
from tests.command_line import run

UNIT = Unit(1, 4)


@pytest.fixture
def runner(tmp_path):
    """The runner of a campaign of eight rigs in units of four."""
    return CaseRunner(load_campaign(write_campaign(tmp_path, keys="rigs = 8\nunit_rigs = 4")))


@pytest.fixture
def folder(tmp_path):
    """The folder of the stored results; it does not exist yet."""
    return tmp_path / "results of a campaign"


def store_rigs(runner, folder, unit, rigs) -> None:
    """Run rigs of a unit and store their results in a folder."""
    with open_store(folder, runner.campaign, runner.sample_values(0)) as store:
        store.add(unit, [runner.run(rig) for rig in rigs])


def missing_rigs(runner, folder, unit=UNIT) -> list[int]:
    """Return the rigs of a unit that have no stored result."""
    with open_store(folder, runner.campaign, runner.sample_values(0)) as store:
        return list(store.missing(unit))


def test_units_cover_every_rig_once_and_stay_when_rigs_are_added(tmp_path):
    def split(rigs):
        return split_into_units(load_campaign(write_campaign(tmp_path, keys="unit_rigs = 4"), rigs), 1e4)

    assert [rig for unit in split(10) for rig in unit.rigs] == list(range(11))
    assert split(8) == split(10)[:3]


def test_the_stored_rows_are_the_values_and_figures_of_the_rigs(runner, folder):
    store_rigs(runner, folder, UNIT, [1, 2, 3, 4])
    table = pyarrow.parquet.read_table(folder / "results")
    for row in table.to_pylist():
        case = runner.run(row["rig"])
        assert {key: row[key] for key in case.values} == case.values
        assert {name: row[name] for name in case.figures} == case.figures
        assert row["status"] == ("passed" if case.has_passed else "failed")
        assert row["steps.trip"] == case.trips["steps"]


def test_rigs_that_come_later_make_the_file_that_all_would_have_made(runner, folder, tmp_path):
    for rigs in ([2, 3], [1], [4]):
        store_rigs(runner, folder, UNIT, rigs)
    store_rigs(runner, tmp_path / "together", UNIT, [1, 2, 3, 4])
    assert result_files(folder) == result_files(tmp_path / "together")
    assert missing_rigs(runner, folder) == []


def test_a_rig_that_is_stored_again_counts_once(runner, folder):
    """A worker may report late, after its rigs ran elsewhere; its report must not change a result."""
    store_rigs(runner, folder, UNIT, [1, 2, 3, 4])
    before = result_files(folder)
    store_rigs(runner, folder, UNIT, [2, 3])
    assert result_files(folder) == before
    assert summarise_campaign(folder).yield_of_rigs.rigs == 4


@pytest.mark.parametrize("length", [0, 4, 500, -1])
def test_a_damaged_file_is_set_aside_and_its_rigs_are_missing(runner, folder, length):
    store_rigs(runner, folder, UNIT, [1, 2, 3, 4])
    (path,) = (folder / "results").iterdir()
    content = path.read_bytes()
    path.write_bytes(content[:length])
    assert missing_rigs(runner, folder) == [1, 2, 3, 4]
    assert [file.name for file in (folder / "results").iterdir()] == [f".{path.name}{DAMAGED}"]
    store_rigs(runner, folder, UNIT, [1, 2, 3, 4])
    assert path.read_bytes() == content


def test_a_damaged_file_is_named_by_the_report(runner, folder):
    store_rigs(runner, folder, UNIT, [1])
    (path,) = (folder / "results").iterdir()
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputFileError, match=r"rigs-000000001-000000004.parquet: damaged .* run the campaign again"):
        summarise_campaign(folder)


def test_the_results_of_another_campaign_are_refused(runner, folder, tmp_path):
    store_rigs(runner, folder, UNIT, [1])
    other_runner = CaseRunner(
        load_campaign(
            write_campaign(tmp_path, keys="rigs = 8\nunit_rigs = 4", experiments=STEPS.replace("10.0", "9.0"))
        )
    )
    with pytest.raises(ConfigError, match="campaign 'stage-paper', which differs from this one in experiments, digest"):
        missing_rigs(other_runner, folder)


def test_two_processes_do_not_write_to_one_folder(runner, folder):
    with (
        open_store(folder, runner.campaign, runner.sample_values(0)),
        pytest.raises(UnavailableError, match="another process runs this campaign"),
    ):
        missing_rigs(runner, folder)
    assert missing_rigs(runner, folder) == [1, 2, 3, 4]


def test_a_write_that_fails_loses_no_earlier_result(runner, folder, monkeypatch):
    store_rigs(runner, folder, UNIT, [1, 2])
    before = result_files(folder)

    def refuse(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(OutputError, match="No space left on device"):
        store_rigs(runner, folder, UNIT, [3])
    monkeypatch.undo()
    assert result_files(folder) == before
    assert missing_rigs(runner, folder) == [3, 4]


def test_the_summary_counts_every_state_of_a_rig(runner, folder):
    store_rigs(runner, folder, Unit(0, 0), [0])
    passed, failed = runner.run(1), runner.run(2)
    passed, failed = ({**vars(case)} for case in (passed, failed))
    passed["missed"], passed["ratio"] = (), 0.5
    failed["missed"], failed["ratio"] = ("steps.settling_ms", "steps tripped: oscillation, late"), math.inf
    refused = {**vars(runner.run(3)), "figures": {}, "trips": {}, "missed": (), "ratio": math.nan, "refusal": "no rig"}
    cases = [type(runner.run(1))(**fields) for fields in (passed, failed, refused)]
    with open_store(folder, runner.campaign, runner.sample_values(0)) as store:
        store.add(UNIT, [*cases, crashed_case(4, runner.sample_values(4))])
    summary = summarise_campaign(folder)
    assert summary.counts == {"passed": 1, "failed": 1, "refused": 1, "crashed": 1}
    assert (summary.yield_of_rigs.passed, summary.yield_of_rigs.rigs) == (1, 3)
    assert summary.causes == {"steps.settling_ms": 1, "steps tripped: oscillation, late": 1}
    assert summary.crashed == (4,)
    assert summary.refused == ((3, "no rig"),)
    assert [rig.rig for rig in summary.worst_rigs] == [2, 1]
    assert summary.nominal["rig"] == 0


def test_a_kill_between_writing_and_removing_a_file_stores_no_rig_twice(runner, folder):
    """A campaign with more rigs has longer files; the shorter file that a kill left is removed."""
    store_rigs(runner, folder, Unit(1, 2), [1, 2])
    (short,) = (folder / "results").iterdir()
    content = short.read_bytes()
    store_rigs(runner, folder, UNIT, [3, 4])
    short.write_bytes(content)
    with pytest.raises(
        InputFileError, match="some rigs are stored twice, as after a run that was killed; run the campaign again"
    ):
        summarise_campaign(folder)
    assert missing_rigs(runner, folder) == []
    assert summarise_campaign(folder).yield_of_rigs.rigs == 4


def test_a_shorter_file_that_cannot_be_removed_is_named_and_the_folder_is_free_again(runner, folder, monkeypatch):
    """The system may refuse to delete a file, as in a folder of another user."""
    store_rigs(runner, folder, Unit(1, 2), [1, 2])
    (short,) = (folder / "results").iterdir()
    content = short.read_bytes()

    def refuse(path, missing_ok=False) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refuse)
        with pytest.raises(OutputError, match=f"{short.name}: Permission denied"):
            store_rigs(runner, folder, UNIT, [3, 4])
        with pytest.raises(OutputError, match=f"{short.name}: Permission denied"):
            missing_rigs(runner, folder)
    assert short.read_bytes() == content
    assert missing_rigs(runner, folder) == []


def test_fewer_rigs_than_before_delete_no_row(runner, folder):
    store_rigs(runner, folder, UNIT, [2, 3, 4])
    store_rigs(runner, folder, Unit(1, 2), [1])
    assert summarise_campaign(folder).yield_of_rigs.rigs == 4


def test_a_campaign_of_fewer_rigs_than_the_folder_has_is_refused(runner, folder, tmp_path):
    store_rigs(runner, folder, UNIT, [2, 3, 4])
    path = write_campaign(tmp_path, keys="rigs = 3\nunit_rigs = 4")
    result = run("campaign", "run", path, "--out", folder)
    assert result.exit_code == 78
    assert "rigs: 3; the folder has results of 4; allowed: 4 or more, or another folder with --out" in result.stderr


def test_a_file_of_another_name_is_ignored_and_one_that_cannot_be_read_stays(runner, folder):
    store_rigs(runner, folder, UNIT, [1, 2, 3, 4])
    (path,) = (folder / "results").iterdir()
    (folder / "results/rigs-copy.parquet").write_bytes(path.read_bytes())
    assert missing_rigs(runner, folder) == []
    assert summarise_campaign(folder).yield_of_rigs.rigs == 4
    path.unlink()
    path.symlink_to("rigs-copy.parquet")
    with pytest.raises(OutputError, match=path.name):
        missing_rigs(runner, folder)
    assert path.is_symlink()


def test_the_results_of_another_version_are_refused(runner, folder, monkeypatch):
    store_rigs(runner, folder, UNIT, [1])
    monkeypatch.setattr("rtloop.campaigns.unit.__version__", "0.0.1")
    with pytest.raises(ConfigError, match="which differs from this one in versions"):
        missing_rigs(runner, folder)
