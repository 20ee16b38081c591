"""A driver of one's own: a package with a driver that runs without hardware, its test and a configuration."""

from __future__ import annotations

from rtloop.starters.law import class_name
from rtloop.starters.templates import fill_template


def driver_files(kind: str) -> dict[str, str]:
    """Return the texts of KIND.py, test_KIND.py, pyproject.toml and KIND.toml by file name.

    `kind` is a Python name in small letters, and the kind of the driver in a configuration.
    """
    values = {"kind": kind, "title": class_name(kind), "distribution": kind.replace("_", "-")}
    templates = {
        f"{kind}.py": "driver.py",
        f"test_{kind}.py": "test_driver.py",
        "pyproject.toml": "driver-pyproject.toml",
        f"{kind}.toml": "driver.toml",
    }
    return {file: fill_template(template, **values) for file, template in templates.items()}
