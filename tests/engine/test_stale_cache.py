"""An edited law is the law that runs: the compiler's cache cannot serve the one from before the edit.

The compiler itself looks only at the file of the outermost function; the edit here is in a module below it.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = """
import json
import numpy as np
from rtloop.law.law import evaluate
from rtloop.law.layout import COEFFICIENTS, CONDITIONS, initial_state, records

coefficients = records(COEFFICIENTS, 1)
axes, loop = initial_state(coefficients)
evaluate(coefficients, axes, loop[0], np.zeros(1), np.full(1, 5.0), records(CONDITIONS, 1)[0])
hits = sum(evaluate.stats.cache_hits.values())
print(json.dumps({"usable": bool(axes["usable"][0]), "from_cache": hits == 1}))
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    for package in ("hil", "drivers", "rtloop"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


def run(project: Path) -> dict[str, bool]:
    """Whether the law accepts a reference of 5, and whether its machine code came from the cache."""
    environment = {**os.environ, "PYTHONPATH": str(project), "XDG_CACHE_HOME": str(project / "cache")}
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=project, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def edit(path: Path, old: str, new: str) -> None:
    source = path.read_text()
    assert source.count(old) == 1
    path.write_text(source.replace(old, new))


def test_an_edited_law_runs(project):
    assert run(project) == {"usable": True, "from_cache": False}
    assert run(project) == {"usable": True, "from_cache": True}
    edit(project / "rtloop/law/safety.py", "USABLE_MAGNITUDE = 1e9", "USABLE_MAGNITUDE = 1.0")
    assert run(project) == {"usable": False, "from_cache": False}


def test_this_test_can_fail(project):
    """With a cache that does not look at the sources the edited law is the old one."""
    blind = 'def source_digest() -> str:\n    return "blind"\n\n\ndef unused() -> str:'
    edit(project / "hil/compiled.py", "def source_digest() -> str:", blind)
    assert run(project) == {"usable": True, "from_cache": False}
    edit(project / "rtloop/law/safety.py", "USABLE_MAGNITUDE = 1e9", "USABLE_MAGNITUDE = 1.0")
    assert run(project) == {"usable": True, "from_cache": True}
