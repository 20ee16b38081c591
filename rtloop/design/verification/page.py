"""HTML page of a verification, self-contained: tables and pictures, no network, no other file, no script."""

from __future__ import annotations

from collections.abc import Sequence

from rtloop.design.verification import text
from rtloop.design.verification.verify import Verification
from rtloop.values import render_page


def page(title: str, axes: Sequence[tuple[str, Verification, dict[str, bytes]]]) -> str:
    """Return the HTML page of all axes, each as (name, verification, PNG bytes by name)."""
    return render_page(__package__, title=title, axes=axes, words=text)
