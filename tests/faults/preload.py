"""Build of a small C library that is put in front of libc for the processes of one bench."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

from tests.faults.fault import NotPossible


def preload(folder: Path, name: str) -> dict[str, str]:
    """Compile NAME.c and return the environment that preloads it. Raises NotPossible without a C compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        raise NotPossible(f"no C compiler for {name}.c")
    library = folder / f"{name}.so"
    source = Path(__file__).with_name(f"{name}.c")
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl"], check=True)
    return {"LD_PRELOAD": str(library)}
