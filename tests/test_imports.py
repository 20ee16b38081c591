"""Programs that start often import only modules that every run of them needs: each import delays every start."""

from __future__ import annotations

import ast
import importlib
import importlib.metadata
import inspect
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.file import FileOptions
from rtloop.foundation.native import cache
from rtloop.foundation.options import Options
from rtloop.hil.options import PlantOptions, RigOptions
from tests.recording.real_loop import PAPER, record

ROOT = Path(__file__).parents[1]
HEAVY = ("scipy.signal", "scipy.stats", "scipy.optimize", "scipy.interpolate", "numba", "matplotlib", "pyarrow")


def inner_imports(module: str, function: str) -> set[str]:
    """Return the modules that a function, or the callback of a command, imports when it runs."""
    code = getattr(importlib.import_module(module), function)
    source = inspect.getsource(inspect.unwrap(getattr(code, "callback", code)))
    return {node.module for node in ast.walk(ast.parse(textwrap.dedent(source))) if isinstance(node, ast.ImportFrom)}


@pytest.mark.parametrize(
    ("module", "forbidden"),
    [
        ("rtloop", ("numpy", "pydantic", "click", "rich")),
        ("rtloop.cli", ("numpy", "pydantic")),
        ("rtloop.client", ("numpy", "pydantic")),
        ("rtloop.client.connection", ("numpy", "pydantic")),
        ("rtloop.cli.run:run_configuration", ("scipy", "uvicorn")),
        ("rtloop.cli.check:check", ("scipy",)),
        ("rtloop.workbench.check_text:print_axis,_print_analyses", ("scipy",)),
        ("rtloop.cli.experiment:run_experiments,_load_stage,_record", ("scipy", "uvicorn")),
        ("rtloop.cli.replay:replay", ("scipy", "rtloop.configuration")),
        ("rtloop.service.daemon", ("scipy",)),
        ("rtloop.engine.process", ("scipy",)),
        ("rtloop.recording.capture.recorder", ("scipy", "pydantic")),
    ],
)
def test_nothing_heavy(module: str, forbidden: tuple[str, ...]):
    """`module:f,g` names what commands import while they run: the modules imported inside these functions."""
    module, _, functions = module.partition(":")
    modules = [module, *(inner for name in functions.split(",") if name for inner in inner_imports(module, name))]
    program = f"import sys, {', '.join(modules)}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert not {*HEAVY, *forbidden} & {*done.stdout.split()}


@pytest.mark.parametrize(
    ("arguments", "module", "forbidden"),
    [
        (("check", "deploy/paper.toml"), "rtloop.workbench.check", ("scipy", "control", "uvicorn")),
        (("info", "RECORDING", "--json"), "rtloop.recording.views.summary", ("scipy", "rich.console", "uvicorn")),
        (("replay", "RECORDING", "--json"), "rtloop.workbench.replay", ("scipy", "rich.console", "uvicorn")),
    ],
)
def test_nothing_heavy_while_a_command_runs(
    arguments: tuple[str, ...], module: str, forbidden: tuple[str, ...], tmp_path: Path
):
    (recording,) = record(tmp_path / "run.mcap", PAPER, 20_000)
    program = """
import atexit, sys
atexit.register(lambda: print(*sys.modules, file=sys.stderr))
from rtloop.cli import main
main(sys.argv[1:])
"""
    words = [str(recording) if word == "RECORDING" else word for word in arguments]
    done = subprocess.run([sys.executable, "-c", program, *words], capture_output=True, text=True, check=True, cwd=ROOT)
    loaded = {*done.stderr.split()}
    assert module in loaded
    assert not {*HEAVY, *forbidden} & loaded


def test_the_versions_in_the_digest_of_a_cache_are_those_of_the_metadata():
    for package in ("numba", "llvmlite"):
        assert cache.installed_version(package) == importlib.metadata.version(package)
    assert cache.installed_version("rtloop") == importlib.metadata.version("rtloop")  # whose folder may lie elsewhere


def test_pydantic_loads_no_plug_ins_under_the_command_line():
    program = "import rtloop.cli; from pydantic.plugin import _loader; print(*_loader.get_plugins(), _loader._plugins)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "None"


def test_an_import_builds_no_validator_of_options():
    """A nested model as a default would build a validator, besides the one of the whole file."""
    program = """
import rtloop.service.daemon
from rtloop.foundation.options import Options
models = [Options]
while models:
    model = models.pop()
    models += model.__subclasses__()
    if model.__pydantic_complete__:
        print(model.__name__)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_absent_tables_have_the_values_of_a_validated_empty_table():
    for model in (AxisOptions, FileOptions, PlantOptions, RigOptions):
        for field in model.model_fields.values():
            if isinstance(field.default, Options):
                empty = type(field.default)()
                assert field.default == empty
                assert field.default.model_fields_set == empty.model_fields_set
                assert vars(field.default) == vars(empty)


def test_the_command_line_computes_with_one_thread():
    program = "import os, rtloop.cli; print(os.environ['OPENBLAS_NUM_THREADS'])"
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    for setting, used in ((None, "1"), ("4", "4")):
        child_environment = environment if setting is None else environment | {"OPENBLAS_NUM_THREADS": setting}
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=True, env=child_environment
        )
        assert done.stdout.strip() == used


def test_a_start_hardly_looks_for_garbage():
    """With Python's default thresholds hundreds of collections took a fifth of a service's start."""
    count = "print(*(generation['collections'] for generation in gc.get_stats()), file=sys.stderr)"
    program = f"import atexit, gc, sys; atexit.register(lambda: {count}); from rtloop.cli import main; main(['schema'])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert sum(map(int, done.stderr.split())) < 100
