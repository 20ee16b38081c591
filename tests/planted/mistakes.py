"""Planted mistakes, read from the TOML files of this folder. Each entry is one mistake:

    [[mistake]]
    name = "a ramp at 10 kHz never waits"
    file = "rtloop/engine/ramp.py"
    old = "text that occurs exactly once in the file"
    new = "the text with the mistake"
    tests = ["tests/engine/test_ramp.py::test_a_ramp_lasts_a_period_for_every_step"]
    uncompiled = true       # optional: the tests run without the compiler, which saves a minute where kernels change

`tests` are node ids of pytest, each of which must fail; one without `[…]` fails if one of its cases fails. The mutants
in `tests/laws/mutants.py` and `tests/drivers/mutants.py` are different: classes that break the contract of a plug-in,
for the conformance suites.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[1]


@dataclass(frozen=True)
class Mistake:
    """A mistake that a competent programmer could make, and the tests that must fail with it."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    uncompiled: bool = False

    def fault(self, root: Path = ROOT) -> str | None:
        """Return the reason why the entry does not fit the tree below `root`; None if it fits."""
        path = root / self.file
        if not path.is_file():
            return f"{self.file}: there is no such file"
        count = path.read_text(encoding="utf-8").count(self.old)
        if count != 1:
            return f"{self.file}: the old text occurs {count} times; exactly once is needed"
        if self.new == self.old:
            return "the new text is the old text"
        missing = [test for test in self.tests if not (root / test.partition("::")[0]).is_file()]
        return f"{', '.join(missing)}: there is no such file" if missing else None

    def plant(self, root: Path) -> None:
        """Write the mistake into its file in the tree below `root`."""
        path = root / self.file
        path.write_text(path.read_text(encoding="utf-8").replace(self.old, self.new), encoding="utf-8")


def all_mistakes() -> list[Mistake]:
    """Return the mistakes of all files. Raises TypeError for an entry with an unknown or a missing key."""
    mistakes = []
    for path in sorted(FOLDER.glob("*.toml")):
        for entry in tomllib.loads(path.read_text(encoding="utf-8"))["mistake"]:
            mistakes.append(Mistake(**entry | {"tests": tuple(entry["tests"])}))
    return mistakes
