"""A law of one's own: a PI controller that runs, its test and a configuration that uses it."""

from __future__ import annotations

from rtloop.starters.templates import fill_template


def law_files(name: str) -> dict[str, str]:
    """Return the texts of NAME.py, test_NAME.py and NAME.toml by file name.

    `name` is a Python name in small letters.
    """
    values = {"name": name, "title": class_name(name)}
    templates = {f"{name}.py": "law.py", f"test_{name}.py": "test_law.py", f"{name}.toml": "law.toml"}
    return {file: fill_template(template, **values) for file, template in templates.items()}


def class_name(name: str) -> str:
    """Return the name of a class for a name in small letters: MyCard for my_card."""
    return "".join(part.capitalize() for part in name.split("_"))
