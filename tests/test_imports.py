"""What starts often loads nothing that only some uses of it need: a second of import is a second before every run."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

HEAVY = ("scipy.signal", "scipy.stats", "scipy.optimize", "scipy.interpolate", "numba", "matplotlib", "pyarrow")


@pytest.mark.parametrize(
    ("module", "others"),
    [
        ("rtloop.cli", ("numpy", "pydantic")),
        ("rtloop.client", ("numpy", "pydantic")),
        ("rtloop.client.connection", ("numpy", "pydantic")),
        ("rtloop.commands.run", ("uvicorn",)),
        ("rtloop.commands.check", ()),
        ("rtloop.commands.experiment", ("uvicorn",)),
        ("rtloop.service.daemon", ()),
        ("rtloop.engine.process", ("scipy",)),
        ("rtloop.recording.capture.recorder", ("scipy", "pydantic")),
    ],
)
def test_nothing_heavy(module: str, others: tuple[str, ...]):
    program = f"import sys, {module}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert not {*HEAVY, *others} & {*done.stdout.split()}


def test_the_command_line_computes_with_one_thread():
    program = "import os, rtloop.cli; print(os.environ['OPENBLAS_NUM_THREADS'])"
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    for asked, used in ((None, "1"), ("4", "4")):
        given = environment if asked is None else environment | {"OPENBLAS_NUM_THREADS": asked}
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=given)
        assert done.stdout.strip() == used
