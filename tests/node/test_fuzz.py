"""Random datagrams break no rule in the library, built with sanitizers for addresses and undefined behaviour."""

from __future__ import annotations

import json
import shutil
import subprocess

import pytest

from tests.node.conftest import NODE

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def fuzz(compiler: str, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Return the command that builds the library and feeds it random datagrams."""
    if shutil.which("make") is None:
        pytest.skip("no make")
    folder = tmp_path_factory.mktemp("fuzz")
    source = folder / "main.c"
    source.write_text("int main(void) { return 0; }\n", encoding="utf-8")
    probe = [compiler, "-fsanitize=address,undefined", str(source), "-o", str(folder / "probe")]
    if subprocess.run(probe, capture_output=True).returncode or subprocess.run([folder / "probe"]).returncode:
        pytest.skip("the C compiler has no sanitizers")
    return ["make", "-s", "-C", str(NODE), f"BUILD={folder}", f"CC={compiler}"]


def run(command: list[str]) -> list[dict[str, float]]:
    """Run the command and return the figures that it prints: of a node without a key, then of one with a key."""
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    figures = [json.loads(line) for line in result.stdout.splitlines()]
    assert [values["keyed"] for values in figures] == [False, True]
    return figures


def test_random_datagrams_break_no_rule(fuzz: list[str]):
    for figures in run([*fuzz, "test", "SEED=2"]):
        assert figures["datagrams"] == 200_000
        assert (figures["foreign"] > 10_000) is figures["keyed"]
        for name in ("sessions", "watchdog_trips", "old", "refused", "invalid", "writes"):
            assert figures[name] > 1000


@pytest.mark.soak
def test_ten_million_random_datagrams_break_no_rule(fuzz: list[str]):
    assert [figures["datagrams"] for figures in run([*fuzz, "fuzz", "SEED=3"])] == [10_000_000] * 2
