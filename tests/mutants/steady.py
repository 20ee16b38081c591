"""Options and a plug-in of pytest for tests that run alike each time and no longer than necessary."""

from __future__ import annotations

import pytest
from hypothesis import Phase, settings

from tests.mutants.uncompiled import install

OPTIONS = (
    *("-q", "--tb=line", "-p", "no:cacheprovider", "-p", "no:xdist"),
    *("-p", "no:unraisableexception"),  # A process that a test leaves running would end the whole session.
    *("-W", "ignore::pytest.PytestAssertRewriteWarning"),  # The forking process has already imported plug-ins.
)
EXAMPLES = 20
"""Largest number of examples of a property: uncompiled kernels take a thousand times as long as compiled ones."""


class DeterministicTests:
    """Plug-in with which hypothesis draws the same examples each time and does not shrink an example that fails."""

    def __init__(self, *, compiled: bool) -> None:
        self._compiled = compiled

    def pytest_configure(self) -> None:
        """Load the profile of hypothesis and the uncompiled kernels before pytest imports a test module."""
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
        """Limit the examples of each property to EXAMPLES."""
        for item in items:
            function = getattr(item, "function", None)
            own_settings: settings | None = getattr(function, "_hypothesis_internal_use_settings", None)
            if own_settings is not None and own_settings.max_examples > EXAMPLES:
                vars(function)["_hypothesis_internal_use_settings"] = settings(own_settings, max_examples=EXAMPLES)
