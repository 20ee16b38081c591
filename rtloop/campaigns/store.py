"""Results of a campaign on disk: one Parquet file for each unit, written whole or not at all.

    FOLDER/campaign.json            the campaign, which a later call compares with its own
    FOLDER/campaign.lock            locked by the process that adds results
    FOLDER/results/rigs-000000001-000000087.parquet

A file's bytes depend on the campaign and its rigs alone. `pandas.read_parquet(FOLDER/results)` reads all of them.
"""

from __future__ import annotations

import fcntl
import io
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from rtloop.campaigns.campaign_file import Campaign
from rtloop.campaigns.case import SEED_KEY, CaseResult
from rtloop.campaigns.unit import Unit, WorkerFacts
from rtloop.configuration.text_files import InputFileError
from rtloop.errors import ConfigError, MissingExtra, UnavailableError, output_errors
from rtloop.foundation.trusted import close_descriptor, open_own, overwrite_file, replace_file

if TYPE_CHECKING:
    import pyarrow as pa

MANIFEST, RESULTS, LOCK = "campaign.json", "results", "campaign.lock"
_MANIFEST_KEYS = ("campaign", "versions", "sampling", "keys", "experiments", "figures", "limits", "digest")
FILE_NAME = re.compile(r"rigs-(\d{9})-(\d{9})\.parquet")
DAMAGED = ".damaged"
"""Added to the name of a file that cannot be read: its rigs are run again."""
PASSED, FAILED, REFUSED, CRASHED = "passed", "failed", "refused", "crashed"


class Manifest(TypedDict):
    """Content of campaign.json: the campaign, and the versions of packages by name."""

    campaign: str
    digest: str
    versions: dict[str, str]
    experiments: list[dict[str, object]]
    sampling: str
    keys: list[str]
    figures: list[str]
    limits: dict[str, float]


def arrow() -> ModuleType:
    """Return pyarrow. Raises MissingExtra without it."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtra("a campaign needs pyarrow; install it with pip install 'rtloop[campaign]'") from None
    return pyarrow


def crashed_case(rig: int, values: Mapping[str, object]) -> CaseResult:
    """Return the result of a rig whose worker died each time it ran the rig.

    The result has no figures and no trips, `missed` is (CRASHED,), and the ratio infinite.
    """
    return CaseResult(rig, values, {}, {}, (CRASHED,), float("inf"))


def status(case: CaseResult) -> str:
    """Return PASSED, FAILED, REFUSED (the configuration is impossible) or CRASHED (its workers died)."""
    if case.refusal:
        return REFUSED
    return CRASHED if CRASHED in case.missed else PASSED if case.has_passed else FAILED


class Store:
    """Results of one campaign in `folder`.

    Raises ConfigError if the folder has the results of another campaign, InputFileError if its campaign.json cannot be
    read, UnavailableError if another process writes to it, OutputError if the system refuses, MissingExtra without
    pyarrow.
    """

    def __init__(self, folder: Path, campaign: Campaign, nominal: Mapping[str, object]) -> None:
        """Open or make the folder of a campaign; `nominal` has the values of its keys, for the columns' types.

        Of two files of one unit, as a killed process leaves them, the shorter one is removed. Raises as the class
        says.
        """
        self._arrow, self.folder, self._campaign = arrow(), folder, campaign
        self._schema = _schema(self._arrow, campaign, nominal)
        with output_errors(folder):
            (folder / RESULTS).mkdir(parents=True, exist_ok=True)
            self._lock = overwrite_file(folder / LOCK)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            close_descriptor(self._lock)
            raise UnavailableError(f"{folder}: another process runs this campaign; wait for it or stop it") from None
        self._paths: dict[int, Path] = {}
        try:
            self._check_manifest(_manifest(campaign))
            for path in _result_paths(folder):  # a longer file of the same unit, which is later, replaces a shorter one
                first, _ = _rigs(path)
                if first in self._paths:
                    _remove(self._paths[first])
                self._paths[first] = path
        except BaseException:
            self.close()
            raise

    def _check_manifest(self, manifest: Manifest) -> None:
        """Write the manifest to a folder without one.

        Raises ConfigError if the folder has another manifest, InputFileError if that manifest cannot be read, and
        OutputError if the new one cannot be written.
        """
        path = self.folder / MANIFEST
        if not path.exists():
            self._write(path, (json.dumps(manifest, indent=1) + "\n").encode())
        elif (stored := read_manifest(self.folder)) != manifest:
            different = ", ".join(key for key in _MANIFEST_KEYS if stored[key] != manifest[key])
            raise ConfigError(
                str(self.folder),
                [
                    f"the folder has results of campaign {stored['campaign']!r}, which differs from this one in "
                    f"{different} (digest: SHA-256 of all settings); choose another folder with --out"
                ],
            )

    def require_no_further_rigs(self) -> None:
        """Raise ConfigError if the folder has results of rigs beyond the campaign's number of rigs."""
        rigs, last = self._campaign.options.rigs, max((_rigs(path)[1] for path in self._paths.values()), default=0)
        if last > rigs:
            allowed = f"{last} or more, or another folder with --out"
            raise ConfigError(str(self.folder), [f"rigs: {rigs}; the folder has results of {last}; allowed: {allowed}"])

    def close(self) -> None:
        """Release the lock, so that other processes may write to the folder."""
        close_descriptor(self._lock)

    def missing(self, unit: Unit) -> Sequence[int]:
        """Return the rigs of a unit that have no result.

        A file that is damaged or has other columns is renamed, and its rigs are missing. Raises OutputError for a file
        that cannot be read or renamed.
        """
        if unit.first not in self._paths:
            return unit.rigs
        return sorted(set(unit.rigs) - {row["rig"] for row in self._rows(unit)})

    def add(self, unit: Unit, cases: Sequence[CaseResult]) -> None:
        """Write the file of a unit anew with `cases` added, which replace stored results of the same rigs.

        Raises OutputError if the system refuses.
        """
        rows = {row["rig"]: row for row in self._rows(unit)} | {case.rig: self._row(case) for case in cases}
        table = self._arrow.Table.from_pylist([rows[rig] for rig in sorted(rows)], self._schema)
        path, replaced = self.folder / RESULTS / _file_name(unit, max(rows)), self._paths.get(unit.first)
        self._write(path, self._bytes(table))
        self._paths[unit.first] = path
        if replaced is not None and replaced != path:
            _remove(replaced)

    def equals(self, case: CaseResult) -> bool | None:
        """Whether the stored row of the rig equals the row of its result `case` byte for byte; None without a row.

        A damaged file is treated, and OutputError raised, as in `missing`.
        """
        firsts = [first for first in self._paths if first <= case.rig]
        rows = {} if not firsts else {row["rig"]: row for row in self._rows(Unit(max(firsts), case.rig))}
        if case.rig not in rows:
            return None
        stored_table, case_table = (
            self._arrow.Table.from_pylist([row], self._schema) for row in (rows[case.rig], self._row(case))
        )
        return self._bytes(stored_table) == self._bytes(case_table)

    def _bytes(self, table: pa.Table) -> bytes:
        """Return a table as the content of a Parquet file."""
        content = io.BytesIO()
        self._arrow.parquet.write_table(table, content, compression="zstd")
        return content.getvalue()

    def _rows(self, unit: Unit) -> list[dict[str, Any]]:
        """Return the rows of the file that begins with the unit's first rig, which may have more or fewer rigs.

        Returns [] without such a file, and for a damaged one or one with other columns, which is renamed. Raises
        OutputError for a file that cannot be read or renamed.
        """
        path = self._paths.get(unit.first)
        if path is None:
            return []
        try:
            with output_errors(path):
                table = _read_table(self._arrow, path)
            if table.schema != self._schema:
                raise ValueError("other columns")
        except ValueError:
            with output_errors(path):
                path.rename(path.with_name(f".{path.name}{DAMAGED}"))
            del self._paths[unit.first]
            return []
        return table.to_pylist()

    def _row(self, case: CaseResult) -> dict[str, object]:
        """Return the row of a result by column, with None in columns for which it has no value."""
        verdict = {"rig": case.rig, "status": status(case), "ratio": case.ratio}
        missed = case.refusal or "; ".join(case.missed)
        trips = {f"{label}.trip": trip for label, trip in case.trips.items()}
        return {
            **dict.fromkeys(self._schema.names),
            **case.values,
            **case.figures,
            **trips,
            **verdict,
            "missed": missed,
        }

    def _write(self, path: Path, content: bytes) -> None:
        """Write a file whole: under another name, to the disk, then renamed. Raises OutputError."""
        part = path.with_name(f".{path.name}.part")
        with output_errors(path):
            try:
                with os.fdopen(replace_file(part), "wb") as file:
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
                part.replace(path)
            except BaseException:
                with suppress(OSError):
                    part.unlink(missing_ok=True)
                raise


def _manifest(campaign: Campaign) -> Manifest:
    """Return the content of campaign.json: _MANIFEST_KEYS with the campaign's values, and the versions of packages."""
    return {
        "campaign": campaign.name,
        "digest": campaign.digest,
        "versions": dict(WorkerFacts.of_this_process().versions),
        "experiments": [experiment.model_dump(mode="json") for experiment in campaign.options.experiment],
        "sampling": campaign.options.sampling,
        "keys": list(campaign.options.uncertain),
        "figures": list(campaign.options.figures),
        "limits": dict(campaign.limits),
    }


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest of a campaign's folder, with _MANIFEST_KEYS at least.

    Raises InputFileError if the manifest is missing, cannot be read or lacks one of these keys.
    """
    path = folder / MANIFEST
    try:
        with os.fdopen(open_own(path), "rb") as file:
            manifest: Manifest = json.load(file)
    except OSError as error:
        raise InputFileError(f"{path}: {error.strerror or error}; choose the folder of a campaign's results") from None
    except ValueError:
        raise InputFileError(f"{path}: not valid JSON; choose the folder of a campaign's results") from None
    if not isinstance(manifest, dict) or set(_MANIFEST_KEYS) - manifest.keys():
        raise InputFileError(
            f"{path}: not the manifest of a campaign, which has the keys {', '.join(_MANIFEST_KEYS)}; choose the "
            "folder of a campaign's results"
        )
    return manifest


def read_tables(folder: Path) -> Iterator[pa.Table]:
    """Yield the table of each file of results in a campaign's folder, sorted by the file's first rig.

    Raises InputFileError for a folder without a manifest or results and for a damaged file, MissingExtra without
    pyarrow.
    """
    library = arrow()
    read_manifest(folder)
    paths = _result_paths(folder)
    if not paths:
        raise InputFileError(f"{folder}: no results; run the campaign")
    for path in paths:
        try:
            yield _read_table(library, path)
        except (OSError, ValueError) as error:
            raise InputFileError(
                f"{path}: damaged ({error}); run the campaign again, which repeats the rigs of this file"
            ) from None


def read_columns(folder: Path) -> dict[str, np.ndarray]:
    """Return the columns of all results in a campaign's folder by name, (rigs,); equal texts are one object.

    A missing text is "", a missing number NaN. Raises InputFileError for a folder without results, for a damaged file
    and for a rig with two results, MissingExtra without pyarrow.
    """
    library = arrow()
    table = library.concat_tables(list(read_tables(folder)))
    rigs = table.column("rig").to_numpy()
    if np.unique(rigs).size != rigs.size:
        raise InputFileError(
            f"{folder}: some rigs are stored twice, as after a run that was killed; run the campaign again: this "
            "removes the second copies"
        )
    return {name: _values(library, table.column(name)) for name in table.column_names}


def _values(library: ModuleType, column: pa.ChunkedArray) -> np.ndarray:
    """Return a column as an array (rigs,), of objects for texts; `library` is pyarrow. A missing text is ""."""
    if not library.types.is_string(column.type):
        return column.to_numpy(zero_copy_only=False)
    encoded = column.fill_null("").combine_chunks().dictionary_encode()
    return np.array(encoded.dictionary.to_pylist(), object)[encoded.indices.to_numpy()]


def _read_table(library: ModuleType, path: Path) -> pa.Table:
    """Return the Arrow table of a file; `library` is pyarrow.

    Raises OSError for a file that cannot be read, ValueError for one that is damaged.
    """
    with os.fdopen(open_own(path), "rb") as file:
        return library.parquet.read_table(io.BytesIO(file.read()), use_threads=False, pre_buffer=False)


def _schema(library: ModuleType, campaign: Campaign, nominal: Mapping[str, object]) -> pa.Schema:
    """Return the Arrow schema of the columns: rig, status, missed, ratio, values of keys, figures, causes of trips.

    `library` is pyarrow; `nominal` has a value of each key, for its column's type.
    """
    columns = [("rig", library.int64()), ("status", library.string()), ("missed", library.string())]
    columns += [("ratio", library.float64()), (SEED_KEY, library.int64())]
    columns += [(key, _column_type(library, value)) for key, value in nominal.items() if key != SEED_KEY]
    columns += [(name, library.float64()) for name in campaign.options.figures]
    columns += [(f"{experiment.label}.trip", library.string()) for experiment in campaign.options.experiment]
    return library.schema(columns)


def _column_type(library: ModuleType, value: object) -> pa.DataType:
    """Return the Arrow type of a column whose nominal value is `value`: truth value, integer, text, or else a float."""
    if isinstance(value, bool):
        return library.bool_()
    if isinstance(value, int):
        return library.int64()
    return library.string() if isinstance(value, str) else library.float64()


def _file_name(unit: Unit, last: int) -> str:
    """Return "rigs-FIRST-LAST.parquet", the name of a unit's file; names sort as rigs do.

    FIRST and LAST are the unit's own, but LAST is the last stored rig, `last`, if that is greater.
    """
    return f"rigs-{unit.first:09d}-{max(unit.last, last):09d}.parquet"


def _result_paths(folder: Path) -> list[Path]:
    """Return the files of results in a folder, by their rigs; files of other names are ignored."""
    return sorted(path for path in (folder / RESULTS).glob("*.parquet") if FILE_NAME.fullmatch(path.name))


def _remove(path: Path) -> None:
    """Remove a file, if it exists. Raises OutputError if the system refuses."""
    with output_errors(path):
        path.unlink(missing_ok=True)


def _rigs(path: Path) -> tuple[int, int]:
    """Return the numbers of the first and the last rig of a file of results, from its name; zeros for another name."""
    match = FILE_NAME.fullmatch(path.name)
    return (int(match[1]), int(match[2])) if match else (0, 0)


@contextmanager
def open_store(folder: Path, campaign: Campaign, nominal: Mapping[str, object]) -> Iterator[Store]:
    """Open the store of a campaign's results in `folder` for a block, and close it.

    `nominal` has the configured value of each uncertain key. Raises UnavailableError while another process uses the
    folder, and the other errors of Store.
    """
    store = Store(folder, campaign, nominal)
    try:
        yield store
    finally:
        store.close()
