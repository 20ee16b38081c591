"""The surroundings of a process: its folder, environment, streams, limits and user."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from tests.surroundings.planted import MATPLOTLIBRC, plant

RUN = 'exec "$@"'
ANY_OUTPUT = r"No such file|No space left|[Rr]ead-only|Permission denied|File name too long|Too many open files"


@dataclass(frozen=True)
class Surrounding:
    """One row of the table.

    `environment` changes variables, None removes one; {place} is the cell's folder. `shell` is a text of bash that runs
    the command "$@" in the cell's folder. `prepare(place, markers)` writes what lies there. `cause` is a pattern that a
    message matches where exit code or files differ from the clean ones; None: they must be equal. With `same_text`,
    stdout equals the clean one, where two clean runs are equal. With `other_digits`, the last digits of computed files
    may differ. `root` needs root.
    """

    environment: Mapping[str, str | None] = field(default_factory=dict)
    shell: str = RUN
    prepare: Callable[[Path, Path], object] = lambda place, markers: None
    cause: str | None = None
    same_text: bool = True
    other_digits: bool = False
    root: bool = False
    program: tuple[str, ...] = ()
    """Words in place of the console script."""


def _write_matplotlibrc(place: Path, _: Path) -> None:
    (place / ".config" / "matplotlib").mkdir(parents=True)
    (place / ".config" / "matplotlib" / "matplotlibrc").write_text(MATPLOTLIBRC)


def _variable(name: str, *values: str | None, **options: object) -> dict[str, Surrounding]:
    return {
        f"{name}={'-' if value is None else value}": Surrounding({name: value}, **options)  # type: ignore[arg-type]
        for value in values
    }


def _tmpfs(folder: str, size: str = "16k") -> str:
    """Return a shell text that mounts a tiny file system on `folder` for the command alone."""
    inner = f"mount -t tmpfs -o size={size} none {folder} && head -c 1M /dev/zero > {folder}/full 2>/dev/null; {RUN}"
    return f"exec unshare --mount bash -c '{inner}' bash \"$@\""


SURROUNDINGS: dict[str, Surrounding] = {
    "planted": Surrounding(prepare=plant),
    "planted, python -m": Surrounding(
        prepare=lambda place, markers: plant(place, markers, ("rtloop",)),
        program=("python", "-m", "rtloop"),
        same_text=False,
    ),
    "planted, PATH=.": Surrounding({"PATH": f".:{os.environ['PATH']}"}, prepare=plant),
    "matplotlibrc at home": Surrounding(
        {"HOME": "{place}", "XDG_CONFIG_HOME": None}, prepare=_write_matplotlibrc
    ),
    **_variable("MPLBACKEND", "garbage", "TkAgg", "module://planted_plugin"),
    **_variable("NUMBA_DISABLE_JIT", "1", "garbage", same_text=True),
    **_variable("NUMBA_OPT", "0", "garbage"),
    **_variable("NUMBA_CPU_NAME", "generic", "garbage"),
    **_variable("NUMBA_DEBUG", "1"),
    **_variable("NUMBA_BOUNDSCHECK", "1"),
    "ASCII": Surrounding({"PYTHONIOENCODING": "ascii"}, same_text=False),
    "ASCII strict": Surrounding({"PYTHONIOENCODING": "ascii:strict"}, same_text=False),
    "LC_ALL=C, no UTF-8": Surrounding(
        {"LC_ALL": "C", "LANG": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}, same_text=False
    ),
    "LC_ALL=C": Surrounding({"LC_ALL": "C", "LANG": "C"}),
    **_variable("LC_ALL", "xx_YY.garbage"),
    **_variable("PYTHONOPTIMIZE", "1"),
    **_variable("PYTHONOPTIMIZE", "2", cause="PYTHONOPTIMIZE=2: help and descriptions are missing"),
    **_variable("PYTHONWARNINGS", "error", "garbage"),
    **_variable("PYTHONDONTWRITEBYTECODE", "1"),
    **_variable("PYTHONHASHSEED", "1"),
    **_variable("PYTHONNOUSERSITE", "1"),
    **_variable("PYTHONSAFEPATH", "1"),
    **_variable("PYTHONDEVMODE", "1"),
    **_variable("PYTHONUNBUFFERED", "1"),
    **_variable("PYTHONPATH", "/nonexistent"),
    **_variable("TMPDIR", "/nonexistent", "/proc", "relative"),
    "TMPDIR full": Surrounding(
        {"TMPDIR": "{place}/tmp"}, _tmpfs("tmp"), lambda place, _: (place / "tmp").mkdir(), ANY_OUTPUT, root=True
    ),
    "no temporary folder": Surrounding(
        shell=f"exec unshare --mount bash -c 'mount -t tmpfs -o ro none /tmp; mount -t tmpfs -o ro none /var/tmp; "
        f"{RUN}' bash \"$@\"", cause=ANY_OUTPUT, root=True,
    ),
    **_variable("HOME", None, "", "/nonexistent", "/proc", "/dev/full", "relative"),
    "HOME full, cold cache": Surrounding(
        {"HOME": "{place}/home", "XDG_CACHE_HOME": None}, _tmpfs("home", "64k"),
        lambda place, _: (place / "home").mkdir(), root=True,
    ),
    "XDG odd": Surrounding(
        dict.fromkeys(("XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_RUNTIME_DIR", "XDG_STATE_HOME"), "/dev/null/x")
    ),
    "umask 0": Surrounding(shell=f"umask 0; {RUN}"),
    "umask 0777": Surrounding(shell=f"umask 0777; {RUN}"),
    **_variable("OMP_NUM_THREADS", "0", "garbage", "4,2"),
    **_variable("NUMEXPR_MAX_THREADS", "garbage"),
    **_variable("OPENBLAS_NUM_THREADS", "garbage"),
    **_variable("OPENBLAS_NUM_THREADS", "2", same_text=False, other_digits=True),
    **_variable("OPENBLAS_CORETYPE", "garbage"),
    **_variable("COLUMNS", "40", "0", "-3", "garbage", "1", same_text=False),
    **_variable("NO_COLOR", "1"),
    **_variable("FORCE_COLOR", "1", same_text=False),
    **_variable("TERM", "dumb", None, "garbage"),
    **_variable("TZ", "garbage", ":/dev/full"),
    **_variable("RUNTIME_DIRECTORY", "{place}/none/none"),
    "stdin closed": Surrounding(shell=f"{RUN} <&-"),
    "stdout closed": Surrounding(shell=f"{RUN} >&-", same_text=False),
    "stderr closed": Surrounding(shell=f"{RUN} 2>&-"),
    "all closed": Surrounding(shell=f"{RUN} <&- >&- 2>&-", same_text=False),
    "stdout ends": Surrounding(shell=f"{RUN} > >(:)", same_text=False, cause="^$"),
    "stdout full": Surrounding(shell=f"{RUN} > /dev/full", same_text=False, cause="No space left"),
    "stderr full": Surrounding(shell=f"{RUN} 2> /dev/full", cause="^$"),
    "folder deleted": Surrounding(
        shell=f"mkdir gone; cd gone; rmdir ../gone; {RUN}", cause=ANY_OUTPUT, same_text=False
    ),
    "folder read-only": Surrounding(
        shell="exec unshare --mount bash -c 'mount --bind . . && mount -o remount,ro,bind . && cd \"$PWD\"; "
        f"{RUN}' bash \"$@\"", cause=ANY_OUTPUT, root=True, same_text=False,
    ),
    "64 files": Surrounding(shell=f"ulimit -n 64; {RUN}", cause=ANY_OUTPUT),
    "long path": Surrounding(
        shell=f'for i in $(seq 15); do d=$(printf "%0200d" $i); mkdir $d; cd $d; done; {RUN}',
        cause=ANY_OUTPUT, same_text=False,
    ),
    "newline in the path": Surrounding(shell=f"mkdir $'a\\nb'; cd $'a\\nb'; {RUN}", same_text=False),
    "no UTF-8 in the path": Surrounding(shell=f"mkdir $'a\\xff'; cd $'a\\xff'; {RUN}", same_text=False),
    "spaces and quotes in the path": Surrounding(
        shell=f"mkdir \"a 'b [red]\"; cd \"a 'b [red]\"; {RUN}", same_text=False
    ),
}  # fmt: skip
