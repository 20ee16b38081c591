"""An edited law runs as edited: the compiler's cache does not return the machine code from before the edit.

The compiler itself checks only the file of the outermost function; the tests edit a module that it imports.
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
from rtloop.kernel.step import set_mode
from rtloop.kernel.layout import FUNCTIONS
from rtloop.kernel.memory import LawMemory, Layout

layout = Layout(())
law = LawMemory.create_at_rest(layout, np.zeros(0, FUNCTIONS), np.zeros(1, layout.coefficients))
set_mode(law.law, 1, False)
hits = sum(set_mode.stats.cache_hits.values())
print(json.dumps({"tap_index": int(law.axes["tap_index"][0]), "from_cache": hits == 1}))
"""
"""Program that changes the mode: the kernel calls another one in `prefilter.py`."""
EDIT = ("rtloop/kernel/prefilter.py", "state.tap_index = REFILL", "state.tap_index = -2")


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Return a folder with a copy of the package, without caches."""
    shutil.copytree(ROOT / "rtloop", tmp_path / "rtloop", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


def run(project: Path) -> dict[str, object]:
    """Return the pre-filter's index after a change of mode, and whether the machine code came from the cache."""
    environment = {**os.environ, "PYTHONPATH": str(project), "XDG_CACHE_HOME": str(project / "cache")}
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=project, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def edit(project: Path, path: str, old: str, new: str) -> None:
    """Replace the only occurrence of `old` in a file of the project."""
    source = (project / path).read_text()
    assert source.count(old) == 1
    (project / path).write_text(source.replace(old, new))


def test_an_edited_law_runs(project):
    assert run(project) == {"tap_index": -1, "from_cache": False}
    assert run(project) == {"tap_index": -1, "from_cache": True}
    edit(project, *EDIT)
    assert run(project) == {"tap_index": -2, "from_cache": False}


def test_this_test_can_fail(project):
    """A cache that ignores the sources runs the old law after an edit."""
    blind = 'def source_digest() -> str:\n    return "blind"\n\n\ndef unused() -> str:'
    edit(project, "rtloop/foundation/native/cache.py", "def source_digest() -> str:", blind)
    assert run(project) == {"tap_index": -1, "from_cache": False}
    edit(project, *EDIT)
    assert run(project) == {"tap_index": -1, "from_cache": True}
