"""A law imports files beside it: part of its identity, under its limits, and in the recording."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rtloop
from rtloop.configuration.file import load
from rtloop.configuration.laws import Library
from rtloop.configuration.prepare import prepare
from rtloop.errors import ConfigError, RtloopError
from rtloop.laws.helpers import read_helpers
from rtloop.laws.registry import law_class, law_from_text
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.topics.events import law_label
from rtloop.recording.replay.laws import TrustedLaws
from rtloop.recording.replay.replay import replay
from rtloop.service.service import Service
from tests.command_line import run
from tests.engine.harness import AXIS, LoopBench, make_plan, text
from tests.laws.failing import text as law_text
from tests.laws.test_failing import HOLD
from tests.laws.test_replay import CONFIGURATION, TICKS, record_law

HELPER = "from numbers_ki import KI_PER_S\n\ndef gain(period_s):\n    return KI_PER_S * period_s\n"
NUMBERS = "KI_PER_S = 100.0\n"
FUNCTION = "WEIGHTS = (1.0, 2.0)\n\ndef held(value):\n    return value * WEIGHTS[0]\n"
LAW = "import gains\nfrom functions import held\n" + law_text("return held(s.integral_um)").replace(
    "100.0 * self.period_s", "gains.gain(self.period_s)"
)
FILES = {"gains.py": HELPER, "numbers_ki.py": NUMBERS, "functions.py": FUNCTION}


def write(folder: Path, **texts: str) -> Path:
    """Write the files of the law with helpers and its configuration, with `texts` by stem in their place."""
    files = (
        FILES | {"mine.py": LAW, "lab.toml": CONFIGURATION} | {f"{stem}.py": content for stem, content in texts.items()}
    )
    for name, content in files.items():
        (folder / name).write_text(content)
    return folder / "lab.toml"


def mine(configuration: Any) -> Any:
    return next(law for law in configuration.laws if law.kind == "mine")


def fault(config: Path) -> str:
    """Return the faults of a configuration that is refused."""
    with pytest.raises(ConfigError) as refusal:
        prepare(load(config))
    return "; ".join(refusal.value.faults)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the path of a recording of the law with helpers; its files lie beside it, without the law's."""
    folder = tmp_path_factory.mktemp("helpers")
    write(folder)
    return record_law(folder, LAW)


def test_a_law_computes_with_its_helpers_and_their_helpers(tmp_path: Path):
    configuration = load(write(tmp_path))
    assert [(helper.name, helper.text) for helper in mine(configuration).helpers] == [
        ("functions", FUNCTION), ("gains", HELPER), ("numbers_ki", NUMBERS),
    ]  # fmt: skip
    prepare(configuration)
    assert law_class(mine(configuration))(None, 1e-4, None).build()["ki"] == pytest.approx(0.01)


def test_the_digest_is_that_of_the_text_alone_without_helpers_and_changes_with_each_helper(tmp_path: Path):
    plain = law_from_text(law_text(), str(tmp_path / "mine.py"))
    assert plain.sha256 == hashlib.sha256(law_text().encode()).hexdigest()
    digests = {mine(load(write(tmp_path))).sha256}
    for change in (
        {"numbers_ki": "KI_PER_S = 101.0\n"},
        {"functions": FUNCTION + "# edited\n"},
        {"gains": HELPER + "\n"},
    ):
        digests.add(mine(load(write(tmp_path, **change))).sha256)
    assert len(digests) == 4


def test_laws_of_two_folders_have_helpers_of_their_own(tmp_path: Path):
    laws = []
    for number in (3, 7):
        folder = tmp_path / str(number)
        folder.mkdir()
        write(folder, numbers_ki=f"KI_PER_S = {number}.0\n")
        laws.append(Library(folder).find({"file": "mine.py"}, "transfer"))
    built = [law_class(law)(None, 1.0, None).build()["ki"] for law in (*laws, *laws)]
    assert built == [3.0, 7.0, 3.0, 7.0]


def test_a_helper_may_be_imported_while_the_law_is_built(tmp_path: Path):
    lazy = (
        law_text()
        .replace("        return {", "        import gains\n        return {")
        .replace("100.0 *", "gains.gain(1.0) *")
    )
    law = mine(load(write(tmp_path, mine=lazy)))
    (tmp_path / "gains.py").unlink()
    assert law_class(law)(None, 1e-4, None).build()["ki"] == pytest.approx(0.01)


REFUSED = {
    "missing": ({"gains": None}, r"mine\.py, line 1: ModuleNotFoundError: No module named 'gains'"),
    "no Python": ({"numbers_ki": "\ndef f(:\n"}, r"numbers_ki\.py, line 2: SyntaxError"),
    "raises": ({"numbers_ki": "\n\n1 / 0\n"}, r"numbers_ki\.py, line 3: ZeroDivisionError"),
    "lacks a name": ({"numbers_ki": "KI_PER_MS = 0.1\n"},
                     r"gains\.py, line 1: ImportError: cannot import name 'KI_PER_S' from 'numbers_ki'.*KI_PER_MS"),
    "circle": ({"numbers_ki": "import gains\n"}, r"numbers_ki\.py, line 1: ImportError: gains is imported while"),
    "imports the law": ({"numbers_ki": "import mine\n"}, r"mine\.py, line 1: ImportError: gains is imported while"),
    "no text": ({"numbers_ki": b"\xff"}, r"numbers_ki\.py: not a text file in UTF-8"),
    "standard": ({"gains": HELPER + "import random\n", "random": ""},
                 r"gains\.py, line 5: imports random, but .*random\.py has the name of a module of Python"),
    "installed": ({"gains": HELPER + "import scipy.linalg\n", "scipy": ""}, r"scipy\.py has the name of a module"),
    "exits": ({"numbers_ki": "raise SystemExit\n"}, r"law 'mine' \(.*mine\.py\): raised SystemExit"),
    "waits in a tick": ({"functions": FUNCTION.replace("    return", "    print(value)\n    return")},
                        "needs Python's interpreter"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_helper_that_is_refused_is_named_with_its_line(tmp_path: Path, name: str):
    texts, message = REFUSED[name]
    config = write(tmp_path)
    for stem, content in texts.items():
        path = tmp_path / f"{stem}.py"
        if content is None:
            path.unlink()
        else:
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert re.search(message, fault(config))


def untrusted(folder: Path, how: str) -> None:
    path = folder / "numbers_ki.py"
    match how:
        case "link":
            path.rename(folder / "elsewhere")
            path.symlink_to(folder / "elsewhere")
        case "file":
            path.chmod(0o666)
        case "folder":
            folder.chmod(0o777)


@pytest.mark.parametrize(
    ("how", "words"),
    [("link", "a symbolic link"), ("file", "may write to this file"), ("folder", "may write to this folder")],
)
def test_a_helper_that_others_may_change_is_not_run(tmp_path: Path, how: str, words: str):
    config = write(tmp_path, numbers_ki=f"open({str(tmp_path / 'was-run')!r}, 'w')\n" + NUMBERS)
    untrusted(tmp_path, how)
    assert words in fault(config)
    assert not (tmp_path / "was-run").exists()


def test_a_law_with_the_name_of_an_installed_module_may_import_that_module(tmp_path: Path):
    (tmp_path / "scipy.py").write_text(content := "import scipy\n" + law_text())
    assert read_helpers(content, str(tmp_path / "scipy.py")) == ()


def test_the_recording_replays_by_its_files_and_by_itself(recording: Path, tmp_path: Path):
    entry = next(law for law in rtloop.load(recording).header["law"]["laws"] if law["name"] == "mine")
    assert {helper["name"] + ".py": helper["text"] for helper in entry["helpers"]} == FILES
    alone = Path(shutil.copy(recording, tmp_path))
    report = json.loads(run("replay", alone, "--trust-recorded-law", "--json").stdout)
    assert (report["identical"], report["ticks"]) == (True, TICKS)
    named = tmp_path / "named"
    named.mkdir()
    write(named)
    assert run("replay", alone, "--law", named / "mine.py").exit_code == 0
    (recording.parent / "mine.py").write_text(LAW)
    assert run("replay", alone).exit_code == 0
    (recording.parent / "numbers_ki.py").write_text(NUMBERS + "# edited\n")
    result = run("replay", alone)
    assert (result.exit_code, "its file cannot be used (numbers_ki.py has changed since the run)" in result.output) == (
        66,
        True,
    )
    (named / "numbers_ki.py").write_text("KI_PER_S = 99.0\n")
    assert "no installed law equals the law that ran" in run("replay", alone, "--law", named / "mine.py").output


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda helpers: helpers[2].update(text="KI_PER_S = 1.0\n"),
            "the law's text in the recording differs from the law that ran",
        ),
        (lambda helpers: helpers.pop(), "the law's text in the recording differs from the law that ran"),
        (lambda helpers: helpers.append("x"), "helpers: invalid"),
        (lambda helpers: helpers.append({"name": "x", "text": 1}), "helpers: invalid"),
    ],
)
def test_helpers_that_were_altered_in_a_recording_are_refused(tmp_path: Path, change: Any, words: str):
    def alter(header: dict[str, Any]) -> None:
        change(next(law for law in header["law"]["laws"] if law["name"] == "mine")["helpers"])

    write(tmp_path)
    path = record_law(tmp_path, LAW, alter)
    with pytest.raises(RecordingError, match=words):
        replay(rtloop.load(path), trust=TrustedLaws(recorded=True))


def test_a_running_service_keeps_the_helpers_that_it_loaded(tmp_path: Path):
    config = write(tmp_path)
    service = Service(config)
    (tmp_path / "numbers_ki.py").write_text("KI_PER_S = 50.0\n")
    with pytest.raises(RtloopError, match=r"law mine: not loaded when the service started, or changed in its file"):
        service.reload_now()
    coefficients = np.asarray(prepare(service.configuration).plan.coefficients)
    write(tmp_path)
    assert coefficients.tobytes() == np.asarray(prepare(load(config)).plan.coefficients).tobytes()
    service.reload_now()


def test_a_mistake_in_a_helper_trips_as_one_in_the_law(tmp_path: Path):
    """A division by zero and an index beyond the array at tick 200, in a function that the law calls."""
    for number, line in enumerate(("return 1.0 / (count - 200.0)", "return WEIGHTS[int(count) - 190]")):
        folder = tmp_path / str(number)
        folder.mkdir()
        law = law_text("return failing(s.seen, c.limits)")
        (folder / "mine.py").write_text("from faults import failing\n" + law)
        (folder / "faults.py").write_text(f"def failing(count, WEIGHTS):\n    {line}\n")
        bench = LoopBench(make_plan(text(AXIS, HOLD), folder))
        bench.run(1000)
        (trip,) = bench.trips([law_label(law.kind, law.file) for law in bench.plan.laws])
        assert (trip["tick"], trip["what"]["causes"]) == (200, ["law"])
