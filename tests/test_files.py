"""Files that a user names must be regular and not too large, and no message quotes their content."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rtloop.configuration.file import load
from rtloop.configuration.reference_options import TableOptions
from rtloop.configuration.references import MAX_TABLE_BYTES, TableOfSamples, generator_values
from rtloop.configuration.text_files import InputFileError
from rtloop.design.identification.model_sections import read_feedforward
from rtloop.design.synthesis.specification_file import load_specification
from rtloop.errors import ConfigError, RtloopError
from tests.paper_configuration import REFERENCE, built

SECRET = "hunter2"

pytestmark = pytest.mark.timeout(20)  # a read that does not end fails


@pytest.fixture
def strange(tmp_path: Path) -> list[Path]:
    """Paths that can be opened but are no regular files."""
    os.mkfifo(tmp_path / "fifo.toml")
    return [tmp_path / "fifo.toml", Path("/dev/zero"), tmp_path]


def read_table(path: Path) -> None:
    """Read the samples of a reference of kind "table" from `path`."""
    generator_values(TableOptions(kind="table", file=str(path)), 1000.0, (), path.parent, TableOfSamples())


READERS = [
    (load, InputFileError, 1 << 20),
    (load_specification, InputFileError, 1 << 20),
    (read_table, ValueError, MAX_TABLE_BYTES),
]


@pytest.mark.parametrize(("read", "error", "_limit"), READERS)
def test_only_regular_files_are_read(strange, read, error, _limit):
    for path in strange:
        with pytest.raises(error, match=rf"{path}: (not a regular file|Is a directory)"):
            read(path)


@pytest.mark.parametrize(("read", "error", "limit"), READERS)
def test_a_file_has_a_largest_size(tmp_path, read, error, limit):
    path = tmp_path / "large"
    path.touch()
    os.truncate(path, limit + 1)
    with pytest.raises(error, match=f"the file has {limit + 1} bytes; allowed: up to {limit} bytes"):
        read(path)


def test_a_table_has_a_largest_number_of_samples(tmp_path):
    np.save(tmp_path / "bytes.npy", np.zeros(MAX_TABLE_BYTES // 8 + 1, np.uint8))
    with pytest.raises(ValueError, match="8388609 samples; allowed: up to 8388608"):
        read_table(tmp_path / "bytes.npy")


@pytest.mark.parametrize("content", [f"root:{SECRET}:1:2\n", f"1.0\n2.0 {SECRET}\n", f'{{"password": "{SECRET}"}}'])
def test_the_fault_of_a_table_does_not_quote_its_content(tmp_path, content):
    for name in ("shadow", "shadow.npy"):
        (tmp_path / name).write_text(content)
        with pytest.raises(ValueError, match="not one or two columns of numbers") as caught:
            read_table(tmp_path / name)
        assert SECRET not in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [
        f"root:{SECRET}:1:2\n",
        f"[{SECRET}]\n[{SECRET}]\n",
        f"[x.{SECRET}]\n[x.{SECRET}]\n",
        f'[x."it\'s {SECRET}".y]\n[x."it\'s {SECRET}".y]\n',
        f'a = {{ "{SECRET}" = 1, "{SECRET}" = 2 }}\n',
        f'a = "{SECRET}',
        f"a = {SECRET}\n",
        "a = " + "[" * 100_000,
        "a = " + "1" * 5000,
    ],
)
def test_the_fault_of_a_configuration_does_not_quote_its_content(tmp_path, content):
    path = tmp_path / "other.toml"
    path.write_text(content)
    for read in (load, load_specification):
        with pytest.raises(ConfigError, match="not valid TOML: ") as caught:
            read(path)
        assert SECRET not in str(caught.value)


def test_a_configuration_may_name_a_table_in_another_folder(tmp_path):
    (tmp_path / "wave.csv").write_text("1.0\n-2.0  # the lowest\n\n3\n")
    reference = f'kind = "table"\nfile = "{tmp_path}/wave.csv"\n'
    assert built((REFERENCE, reference)).plan.table.tolist() == [1.0, -2.0, 3.0]


def test_a_feedforward_file_is_read_as_a_configuration_is(tmp_path, strange):
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
