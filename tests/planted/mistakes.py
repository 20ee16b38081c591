"""Planted mistakes as data: TOML files beside this one, an entry a mistake.

    [[mistake]]
    name = "a ramp at 10 kHz never waits"
    file = "rtloop/engine/ramp.py"
    old = "text that occurs exactly once in the file"
    new = "the text with the mistake"
    tests = ["tests/engine/test_ramp.py::test_a_ramp_lasts_a_period_for_every_step"]
    uncompiled = true       # optional: the tests run without the compiler, which saves a minute where kernels change

`tests` are node ids of pytest, of which each must go red; one without `[…]` goes red with any of its parameters. The
mutants in `tests/laws/mutants.py` and `tests/drivers/mutants.py` are another thing: plug-ins that break a contract, as
classes for the conformance suites.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[1]


@dataclass(frozen=True)
class Mistake:
    """A mistake that a competent programmer could make, and the tests that it turns red."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    uncompiled: bool = False

    def fault(self, root: Path = ROOT) -> str | None:
        """Why the entry does not fit the tree below `root`; None where it does."""
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
        """Make the mistake in the tree below `root`."""
        path = root / self.file
        path.write_text(path.read_text(encoding="utf-8").replace(self.old, self.new), encoding="utf-8")


def all_mistakes() -> list[Mistake]:
    """Every entry of every file. Raises TypeError for an entry with a key too many or too few."""
    mistakes = []
    for path in sorted(FOLDER.glob("*.toml")):
        for entry in tomllib.loads(path.read_text(encoding="utf-8"))["mistake"]:
            mistakes.append(Mistake(**entry | {"tests": tuple(entry["tests"])}))
    return mistakes
