"""The product opens files by `rtloop.foundation.trusted`; other calls that open one are listed here with reasons.

`os.fdopen` is allowed everywhere, because it takes only a descriptor that is already open.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import rtloop

PACKAGE = Path(rtloop.__file__).parent
TRUSTED = "foundation/trusted.py"
OPENS = {"open", "io.open", "os.open", "codecs.open", "os.mkfifo", "os.mknod"}
METHODS = {"open", "read_text", "read_bytes", "write_text", "write_bytes", "touch", "tofile", "savefig"}
"""Methods of a path, an array or a figure."""
LIBRARIES = {
    *(f"np.{name}" for name in ("load", "save", "savez", "savez_compressed", "memmap", "fromfile", "loadtxt", "savetxt",
                                "genfromtxt")),
    "loadmat", "savemat", "pandas.read_csv", "h5py.File", "zipfile.ZipFile", "gzip.open", "tarfile.open",
    "pyarrow.parquet.ParquetFile", "pyarrow.parquet.ParquetWriter", "logging.FileHandler", "FileResponse",
    "shutil.copy", "shutil.copy2", "shutil.copyfile", "shutil.copytree", "click.File", "click.open_file",
}  # fmt: skip
"""Functions that take a path, or an open file."""
FILES = ("file", "opened", "stream", "part", "lines", "descriptor_path(", "io.BytesIO(", "HeldFile")
"""Prefixes of the first argument of such a function if it is an open file."""
VERBS = {"driver.open", "self._driver.open", "self.open", "loop.open", "self.loop.open", "self.model.open"}
"""Calls of drivers, and of the open loop's frequency response, which open no file."""

KERNEL_FILE = "a fixed path, which the kernel serves"
PACKAGE_FILE = "a file of the installed package"
ALLOWED = {
    ("cli/program.py", "os.open"): KERNEL_FILE,
    ("configuration/text_files.py", "os.open"): "below a folder that is held open, through no link; kind looked at",
    ("doctor/host.py", "(self.root / path.lstrip('/')).read_text"): KERNEL_FILE,
    ("doctor/host.py", "(self.root / 'proc/config.gz').read_bytes"): KERNEL_FILE,
    ("doctor/node_line.py", "Path('/proc/net/if_inet6').read_text"): KERNEL_FILE,
    ("doctor/remedy.py", "path.write_text"): KERNEL_FILE,
    ("engine/heartbeat.py", "os.open"): KERNEL_FILE,
    ("engine/realtime.py", "os.open"): KERNEL_FILE,
    ("supervision/description.py", "open"): KERNEL_FILE,
    ("supervision/child.py", "Path(f'/proc/{pid}/stat').read_text"): KERNEL_FILE,
    ("foundation/native/cache.py", "path.read_bytes"): PACKAGE_FILE,
    ("laws/registry.py", "Path(file or '').read_text"): PACKAGE_FILE,
    ("laws/limited/process.py", "self._file.read_text"): KERNEL_FILE,
    ("laws/limited/worker.py", "os.open"): KERNEL_FILE,
    ("panel/web/application.py", "FileResponse"): PACKAGE_FILE,
    ("panel/web/server.py", "webbrowser.open"): "an address, no file",
    ("interchange/export.py", "archive.open"): "a member of an archive that is open",
    ("recording/file/mcap/chunkfile.py", "os.open"): "a folder, to be synchronised; nothing is read of it",
    ("service/second_opinion.py", "path.read_bytes"): PACKAGE_FILE,
    ("starters/examples.py", "files('rtloop').joinpath('examples', name).read_text"): PACKAGE_FILE,
    ("starters/templates/__init__.py", "files(__name__).joinpath(f'{name}.in').read_text"): PACKAGE_FILE,
    ("supervision/paths.py", "os.open"): "made anew in a folder that `open_folder` holds",
}
"""Reason for each call outside of `trusted`, by (module, call)."""


def opens(text: str) -> Iterator[tuple[int, str]]:
    """Line and function of each call in a source that opens a file by its path."""
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Call) or (called := ast.unparse(node.func)) in VERBS:
            continue
        method = called.rpartition(".")[2] if isinstance(node.func, ast.Attribute) else ""
        argument = ast.unparse(node.args[0]) if node.args else ""
        is_library = called in LIBRARIES or method in ("savefig", "tofile")
        if called in OPENS or (is_library and not argument.startswith(FILES)) or (method in METHODS and not is_library):
            yield node.lineno, called


def sources() -> list[Path]:
    """Return every module of the package; rglob does not follow the links `drivers` and `hil`."""
    rooms = [path for path in PACKAGE.iterdir() if path.is_dir()]
    return sorted([*PACKAGE.glob("*.py"), *(path for room in rooms for path in room.rglob("*.py"))])


def test_every_file_is_opened_by_the_module_that_checks_owners_and_links():
    assert {path.relative_to(PACKAGE).parts[0] for path in sources()} >= {"drivers", "hil", "panel", "recording"}
    calls = {
        (module, called, line)
        for path in sources()
        if (module := path.relative_to(PACKAGE).as_posix()) != TRUSTED
        for line, called in opens(path.read_text("utf-8"))
    }
    unexplained = sorted(
        f"{module}:{line}: {called}" for module, called, line in calls if (module, called) not in ALLOWED
    )
    assert unexplained == [], f"open it by {TRUSTED}, or say in ALLOWED why not"
    stale = ALLOWED.keys() - {(module, called) for module, called, _ in calls}
    assert stale == set(), "these open nothing any more"


@pytest.mark.parametrize(
    "text",
    ["open(path)", "io.open(path)", "os.open(path, 0)", "path.open()", "(folder / name).open('w')", "path.read_text()",
     "path.write_bytes(b'')", "np.load(path)", "np.save(folder / name, a)", "rows.tofile(path)", "h5py.File(path, 'w')",
     "zipfile.ZipFile(path)", "figure.savefig(target, format='png')", "FileResponse(path)", "loadmat(path)",
     "with pyarrow.parquet.ParquetFile(path) as file: pass"],
)  # fmt: skip
def test_an_open_by_a_path_is_found(text: str):
    assert [line for line, _ in opens(text)] == [1]


@pytest.mark.parametrize(
    "text",
    ["os.fdopen(open_named(path))", "np.load(file)", "driver.open()", "loop.open(hz)", "figure.savefig(file, dpi=110)",
     "h5py.File(descriptor_path(opened), 'r')", "read_text(path)", "load(config)"],
)  # fmt: skip
def test_an_open_file_is_not_reported(text: str):
    assert list(opens(text)) == []
