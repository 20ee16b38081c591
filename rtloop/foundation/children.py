"""Command line and environment of child processes, whatever the current folder and the environment hold.

`python -m` looks for modules in the current folder first: a `random.py` in a folder of data would run in the child.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping

SAFE_PATH = {"PYTHONSAFEPATH": "1"}
"""Variable with which Python looks for no module in the current folder, for children that multiprocessing starts."""
THREADS = ("OMP_NUM_THREADS", "NUMEXPR_NUM_THREADS", "NUMEXPR_MAX_THREADS")


def python_command(module: str, *arguments: object) -> list[str]:
    """Return the command line `python -P -m MODULE ARGUMENTS`: the child looks for no module in its current folder."""
    return [sys.executable, "-P", "-m", module, *map(str, arguments)]


def child_environment(changes: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return this process's environment without `harmful_variables`, with SAFE_PATH and `changes`."""
    harmful = harmful_variables()
    return {name: value for name, value in os.environ.items() if name not in harmful} | SAFE_PATH | dict(changes or {})


def harmful_variables() -> list[str]:
    """Return the names of the environment's variables that would change compiled code, or make a child end or lose its
    texts and assertions; among them numbers of threads that are no numbers, at which libraries raise ValueError.
    """
    harmful = {"PYTHONOPTIMIZE", "PYTHONWARNINGS"}
    harmful |= {name for name in THREADS if not os.environ.get(name, "1").isdecimal()}
    return sorted(name for name in os.environ if name.startswith("NUMBA_") or name in harmful)
