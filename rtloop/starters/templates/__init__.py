"""Templates of the files that `rtloop init` and `rtloop law new` write; `$name` stands for a value.

Their names end with .in: the files with Python inside are no modules of rtloop.
"""

from __future__ import annotations

from importlib.resources import files
from string import Template


def fill_template(name: str, /, **values: object) -> str:
    """Return the template NAME.in with each `$key` replaced by its value. Raises KeyError for a key without a value."""
    text = files(__name__).joinpath(f"{name}.in").read_text(encoding="utf-8")
    return Template(text).substitute(values)
