"""Files that a user names: regular ones of a stated size, and nothing of what they hold in any message."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rtloop.configuration.axis import TableOptions
from rtloop.configuration.file import load
from rtloop.configuration.references import MAX_TABLE_BYTES, TableOfSamples, generator_values
from rtloop.configuration.text_files import InputFileError
from rtloop.design.identification.model_sections import read_feedforward
from rtloop.design.synthesis.specification_file import load_specification
from rtloop.errors import ConfigError, RtloopError
from tests.paper_configuration import REFERENCE, built

PATIENCE_S = 20
SECRET = "hunter2"


@pytest.fixture(autouse=True)
def patience() -> Iterator[None]:
    """A read that never ends is a failure, not a test run that never ends."""

    def give_up(*_: object) -> None:
        raise AssertionError(f"still reading after {PATIENCE_S} s")

    previous = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(PATIENCE_S)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, previous)


def table(folder: Path, file: str | Path) -> np.ndarray:
    """The samples of a table reference."""
    samples = TableOfSamples()
    generator_values(TableOptions(kind="table", file=str(file)), 1000.0, (), folder, samples)
    return samples.samples


@pytest.fixture
def strange(tmp_path: Path) -> list[Path]:
    """What may be opened, but is no file with a content of its own."""
    os.mkfifo(tmp_path / "fifo.toml")
    return [tmp_path / "fifo.toml", Path("/dev/zero"), tmp_path]


def test_a_table_is_a_regular_file(tmp_path, strange):
    for path in strange:
        with pytest.raises(ValueError, match=r"^file: .*: (not a regular file|Is a directory)"):
            table(tmp_path, path)


@pytest.mark.parametrize("read", [load, load_specification])
def test_a_configuration_is_a_regular_file(strange, read):
    for path in strange:
        with pytest.raises(InputFileError, match=rf"^{path}: (not a regular file|Is a directory)"):
            read(path)


def test_a_table_has_a_largest_size(tmp_path):
    path = tmp_path / "large.csv"
    path.touch()
    os.truncate(path, MAX_TABLE_BYTES + 1)
    with pytest.raises(ValueError, match=f"{MAX_TABLE_BYTES + 1} bytes; at most {MAX_TABLE_BYTES} are allowed"):
        table(tmp_path, path)


def test_a_table_has_a_largest_number_of_samples(tmp_path):
    np.save(tmp_path / "bytes.npy", np.zeros(MAX_TABLE_BYTES // 8 + 1, np.uint8))
    with pytest.raises(ValueError, match="8388609 samples; at most 8388608 are allowed"):
        table(tmp_path, "bytes.npy")


@pytest.mark.parametrize("read", [load, load_specification])
def test_a_configuration_has_a_largest_size(tmp_path, read):
    path = tmp_path / "large.toml"
    path.write_bytes(b"#" * (5 << 20))
    with pytest.raises(InputFileError, match="5242880 bytes; at most 1048576 are allowed"):
        read(path)


@pytest.mark.parametrize("content", [f"root:{SECRET}:1:2\n", f"1.0\n2.0 {SECRET}\n", f'{{"password": "{SECRET}"}}'])
def test_a_table_that_is_none_is_not_told(tmp_path, content):
    for name in ("shadow", "shadow.npy"):
        (tmp_path / name).write_text(content)
        with pytest.raises(ValueError, match="not one or two columns of numbers") as caught:
            table(tmp_path, name)
        assert SECRET not in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [
        f"root:{SECRET}:1:2\n",
        f"[{SECRET}]\n[{SECRET}]\n",
        f'a = {{ "{SECRET}" = 1, "{SECRET}" = 2 }}\n',
        f'a = "{SECRET}',
        f"a = {SECRET}\n",
        "a = " + "[" * 100_000,
        "a = " + "1" * 5000,
    ],
)
def test_a_configuration_that_is_no_toml_is_not_told(tmp_path, content):
    path = tmp_path / "other.toml"
    path.write_text(content)
    for read in (load, load_specification):
        with pytest.raises(ConfigError, match="not valid TOML: ") as caught:
            read(path)
        assert SECRET not in str(caught.value)


def test_the_owner_of_a_configuration_may_name_a_file_elsewhere(tmp_path):
    (tmp_path / "wave.csv").write_text("1.0\n-2.0  # the lowest\n\n3\n")
    reference = f'kind = "table"\nfile = "{tmp_path}/wave.csv"\n'
    assert built((REFERENCE, reference)).plan.table.tolist() == [1.0, -2.0, 3.0]


def test_a_file_with_a_feedforward_is_read_like_a_configuration(tmp_path, strange):
    binary, other = tmp_path / "binary.toml", tmp_path / "other.toml"
    binary.write_bytes(b"\xff\xfe")
    other.write_text(f"[{SECRET}]\n[{SECRET}]\n")
    for path in (*strange, binary):
        with pytest.raises(RtloopError, match=rf"^{path}: ") as caught:
            read_feedforward(path)
        assert caught.value.exit_code == 66
    with pytest.raises(ConfigError, match="not valid TOML: ") as caught:
        read_feedforward(other)
    assert SECRET not in str(caught.value)
