"""What lies around a process decides nothing: the folder it stands in, its environment, its streams.

The whole table is `make soak NAME=surroundings`; its most telling cells are here.
"""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from rtloop.cli import main
from rtloop.cli.options import OutputPath
from rtloop.foundation.children import child_environment, python_command
from tests.recording.hand_made_loop import make_rows, write_recording
from tests.surroundings.cell import Bench, Ending
from tests.surroundings.commands import PROGRAM, ROOT, Command, clean_environment, missing_commands
from tests.surroundings.planted import plant
from tests.surroundings.surroundings import SURROUNDINGS, Surrounding

pytestmark = pytest.mark.system

STARTS_CHILDREN = {
    "import {stock}/short.csv --rate 1000 --all --out made.mcap": 0,
    "run {stock}/paper.toml --duration 0.01 --unpaced": 0,
    "check {stock}/damping.toml": 0,
    "archive info {stock}/short.mcap --jobs 1": 0,
    "drivers": 0,
    "laws": 0,
    "plot {stock}/short.mcap --out plot.png": 0,
}
"""Commands that start each kind of child, read installed packages, or draw; and their exit codes."""
OUTPUT_OPTIONS = {"out", "plot", "page", "png", "token_file"}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    folder = tmp_path_factory.mktemp("s")
    stock = folder / "stock"
    stock.mkdir()
    for name in ("paper.toml", "paper-spec.toml"):
        shutil.copy(ROOT / "deploy" / name, stock)
    write_recording(stock / "short.mcap", make_rows(500))
    (stock / "short.csv").write_text("a,b\n" + "1.0,2.0\n" * 20)
    environment = clean_environment(folder)
    subprocess.run([PROGRAM, "law", "new", "damping"], cwd=stock, env=environment, check=True, capture_output=True)
    return Bench(folder, stock, environment, folder / "no-service")


numbers: Iterator[int] = iter(range(10**6))


def ending(bench: Bench, words: str, surrounding: Surrounding) -> Ending:
    return bench.run(next(numbers), Command(words), surrounding)


@pytest.mark.parametrize("words", STARTS_CHILDREN)
def test_no_file_of_the_current_folder_runs_or_decides(bench: Bench, words: str) -> None:
    result = ending(bench, words, SURROUNDINGS["planted"])
    assert result.markers == []
    assert result.code == STARTS_CHILDREN[words], result.stderr
    clean = ending(bench, words, Surrounding())
    assert result.files.keys() == clean.files.keys()
    if "plot" in words:
        assert result.files == clean.files


@pytest.mark.parametrize(
    "first", ["rtloop.configuration.second_opinion", "rtloop.design.interchange", "rtloop.recording.views.picture"]
)
def test_whatever_imports_matplotlib_first_leaves_a_matplotlibrc_alone(tmp_path: Path, first: str) -> None:
    (tmp_path / "matplotlibrc").write_text("lines.linewidth: 20\n")
    code = (
        f"import {first}; from rtloop.recording.views.picture import load_matplotlib; "
        "print(load_matplotlib().rcParams['lines.linewidth'])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], cwd=tmp_path, text=True).strip() == "1.5"


def test_python_m_rtloop_leaves_the_current_folder_before_it_imports(bench: Bench) -> None:
    result = ending(bench, "laws", SURROUNDINGS["planted, python -m"])
    assert (result.markers, result.code) == ([], 0), result.stderr


def test_a_number_of_threads_that_is_none_is_one_as_by_default() -> None:
    code = "import os, rtloop.cli; print(os.environ['OPENBLAS_NUM_THREADS'])"
    for value, expected in (("garbage", "1"), ("", "1"), ("2", "2")):
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": value}
        assert subprocess.check_output([sys.executable, "-c", code], env=environment, text=True).strip() == expected


def test_the_planted_files_would_run(tmp_path: Path) -> None:
    """Without this, the tests above could pass because nothing was planted."""
    plant(tmp_path, tmp_path)
    unsafe = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    subprocess.run([sys.executable, "-m", "this"], cwd=tmp_path, capture_output=True, env=unsafe)
    assert (tmp_path / "ran-this").exists()


STARTERS = {"subprocess.Popen", "subprocess.run", "asyncio.create_subprocess_exec"}


def test_every_child_has_the_one_command_and_environment() -> None:
    """`sys.executable` stands in one file, and each start of a process states its environment."""
    users, starts = set(), 0
    for path in sorted((ROOT / "rtloop").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute):
                name = ast.unparse(node)
                assert not name.startswith(("os.system", "os.exec", "os.spawn", "os.posix_spawn")), path
                if name == "sys.executable":
                    users.add(path.name)
            if isinstance(node, ast.Call) and ast.unparse(node.func) in STARTERS:
                starts += 1
                (environment,) = [ast.unparse(word.value) for word in node.keywords if word.arg == "env"]
                assert environment == "environment" or environment.startswith("child_environment("), path
    assert users == {"children.py"}
    assert starts >= 7


def test_numba_is_imported_in_one_place() -> None:
    """Another import could be the first one, and read settings of the current folder."""
    importers = set()
    for path in sorted((ROOT / "rtloop").rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
                node.body = []
        names = {
            name
            for node in ast.walk(tree)
            if isinstance(node, ast.Import | ast.ImportFrom)
            for name in (
                [node.module or ""] if isinstance(node, ast.ImportFrom) else [part.name for part in node.names]
            )
        }
        if any(name.partition(".")[0] == "numba" for name in names):
            importers.add(path.name)
    assert importers == {"compiler.py", "numba_cache_file.py"}


def test_a_law_is_compiled_whatever_the_folder_says_of_numba(bench: Bench) -> None:
    result = ending(bench, "run {stock}/damping.toml --duration 0.05 --unpaced", SURROUNDINGS["planted"])
    assert (result.markers, result.code) == ([], 0), result.stderr


def test_a_number_of_threads_that_is_none_breaks_no_driver(bench: Bench) -> None:
    clean, garbage = (
        ending(bench, "drivers", SURROUNDINGS[name]) for name in ("NO_COLOR=1", "OMP_NUM_THREADS=garbage")
    )
    assert (garbage.stdout, garbage.stderr) == (clean.stdout, clean.stderr)


def test_processes_start_in_development_mode(bench: Bench) -> None:
    result = ending(bench, "archive replay {stock}/short.mcap --jobs 1", SURROUNDINGS["PYTHONDEVMODE=1"])
    assert "Traceback" not in result.stderr
    assert "1 recording" in result.stdout


def test_a_child_gets_no_variable_that_changes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("NUMBA_OPT", "NUMBA_DISABLE_JIT", "PYTHONWARNINGS", "PYTHONOPTIMIZE"):
        monkeypatch.setenv(name, "1")
    environment = child_environment({"ADDED": "1"})
    assert not [name for name in environment if name.startswith(("NUMBA_", "PYTHONWARN", "PYTHONOPT"))]
    assert environment["ADDED"] == environment["PYTHONSAFEPATH"] == "1"
    assert environment["PATH"] == os.environ["PATH"]
    assert python_command("a.b", 1)[1:] == ["-P", "-m", "a.b", "1"]


def test_numba_is_configured_by_neither_environment_nor_folder(tmp_path: Path) -> None:
    (tmp_path / ".numba_config.yaml").write_text("opt: 0\nboundscheck: 1\ndisable_jit: 1\n")
    program = (
        "from rtloop.foundation.native.compiler import numba as n; import yaml\n"
        "n.config.reload_config(); c = n.config\n"
        "print(int(c.OPT), c.BOUNDSCHECK, c.DISABLE_JIT, c.CPU_NAME, c.DEBUG, yaml.__name__)"
    )
    environment = os.environ | {"NUMBA_OPT": "1", "NUMBA_CPU_NAME": "generic", "NUMBA_DEBUG": "1"}
    done = subprocess.run(
        [sys.executable, "-P", "-c", program], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.stdout.split() == ["3", "None", "0", "None", "0", "yaml"], done.stderr


@pytest.mark.parametrize(
    ("name", "code", "message"),
    [
        ("ASCII strict", 0, ""),
        ("LC_ALL=C, no UTF-8", 0, ""),
        ("PYTHONWARNINGS=error", 0, ""),
        ("all closed", 0, ""),
        ("stdout full", 73, "rtloop: standard output: No space left on device"),
        ("stdout ends", None, ""),
        ("folder deleted", 0, ""),
        ("NUMBA_DISABLE_JIT=1", 0, "NUMBA_DISABLE_JIT: no effect"),
        ("COLUMNS=40", 0, ""),
        ("no UTF-8 in the path", 0, ""),
    ],
)
def test_a_recording_is_shown_whatever_the_surroundings(
    bench: Bench, name: str, code: int | None, message: str
) -> None:
    """A closed pipe ends quietly, by 0 or 1: the reader may end before or after the text."""
    result = ending(bench, "info {stock}/short.mcap", SURROUNDINGS[name])
    assert result.code in ((0, 1) if code is None else (code,)), result.stderr
    assert message in result.stderr
    assert "Traceback" not in result.stderr + result.stdout
    assert "Exception ignored" not in result.stderr


def test_an_assertion_of_a_law_stays_whatever_python_leaves_out() -> None:
    program = "from rtloop.laws.registry import laws_in; laws_in('assert False, 1234', 'law.py')"
    done = subprocess.run([sys.executable, "-OO", "-P", "-c", program], capture_output=True, text=True)
    assert "law.py, line 1: AssertionError: 1234" in done.stderr


def test_a_umask_leaves_the_owner_his_rights(bench: Bench, tmp_path: Path) -> None:
    command = ["sh", "-c", 'umask 0777; exec "$@"', "sh", PROGRAM, "init", "new"]
    subprocess.run(command, cwd=tmp_path, env=bench.environment, check=True, capture_output=True)
    assert {path.stat().st_mode & 0o777 for path in (tmp_path / "new").iterdir()} == {0o600}


def test_a_relative_folder_for_caches_is_no_place_of_code(tmp_path: Path) -> None:
    program = "from rtloop.foundation.native.cache import CACHE_FOLDER; print(CACHE_FOLDER)"
    environment = os.environ | {"XDG_CACHE_HOME": "here", "TMPDIR": str(tmp_path / "t")}
    done = subprocess.run(
        [sys.executable, "-P", "-c", program], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert Path(done.stdout.strip()).is_absolute(), done.stderr
    assert list(tmp_path.iterdir()) == []


def test_no_output_is_named_by_a_dash() -> None:
    wrong, seen = [], 0

    def look(command: click.Command, path: str) -> None:
        nonlocal seen
        for parameter in command.params:
            if parameter.name in OUTPUT_OPTIONS:
                seen += 1
                if not isinstance(parameter.type, OutputPath):
                    wrong.append(f"{path} --{parameter.name}")
        for name, subcommand in getattr(command, "commands", {}).items():
            look(subcommand, f"{path} {name}")

    look(main, "rtloop")
    assert wrong == []
    assert seen > 30
    with pytest.raises(click.BadParameter, match=r"value is -; allowed: .* \./- "):
        OutputPath().convert("-", None, None)
    assert OutputPath().convert("./-", None, None) == Path("-")


def test_every_command_has_a_cell() -> None:
    assert missing_commands() == set()
