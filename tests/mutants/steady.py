"""Tests that run in the same way each time, and no longer than they must: options and a plug-in of pytest."""

from __future__ import annotations

import pytest
from hypothesis import Phase, settings

from tests.mutants.uncompiled import install

OPTIONS = (
    *("-q", "--tb=line", "-p", "no:cacheprovider", "-p", "no:xdist"),
    *("-p", "no:unraisableexception"),  # a process that a test leaves behind would end the whole session
    *("-W", "ignore::pytest.PytestAssertRewriteWarning"),  # of plug-ins that the forking process has imported
)
EXAMPLES = 20
"""Of a property that asks for more, for uncompiled kernels take a thousand times as long as compiled ones."""


class Steady:
    """Hypothesis draws the same examples each time, and does not look for the smallest that fails."""

    def __init__(self, *, compiled: bool) -> None:
        self._compiled = compiled

    def pytest_configure(self) -> None:
        """Before any test's module is imported."""
        if not self._compiled:
            install()
        settings.register_profile(
            "steady",
            settings(),
            deadline=None,
            derandomize=True,
            database=None,
            phases=(Phase.explicit, Phase.generate),
        )
        settings.load_profile("steady")

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Fewer examples of the properties that ask for many."""
        for item in items:
            function = getattr(item, "function", None)
            asked: settings | None = getattr(function, "_hypothesis_internal_use_settings", None)
            if asked is not None and asked.max_examples > EXAMPLES:
                vars(function)["_hypothesis_internal_use_settings"] = settings(asked, max_examples=EXAMPLES)
