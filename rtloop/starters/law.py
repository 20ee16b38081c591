"""A law of one's own: a PI controller that runs, its test and a configuration that uses it."""

from __future__ import annotations

import tomllib
from typing import TYPE_CHECKING

from rtloop.starters.templates import fill_template

if TYPE_CHECKING:
    from rtloop.configuration.file import Configuration

SLOW_KI_PER_S = 1.0
"""Integral gain in place of a controller that is no PI controller: too slow for any resonance to matter."""


def law_files(name: str, stage: Configuration | None = None) -> dict[str, str]:
    """Return the texts of NAME.py, test_NAME.py and NAME.toml by file name.

    `name` is a Python name in small letters. NAME.toml is the configuration `stage` with this law in its first axis;
    None: the paper's rig.
    """
    values = {"name": name, "title": class_name(name)}
    templates = {f"{name}.py": "law.py", f"test_{name}.py": "test_law.py", f"{name}.toml": "law.toml"}
    texts = {file: fill_template(template, **values) for file, template in templates.items()}
    return texts if stage is None else texts | {f"{name}.toml": _stage_text(name, stage)}


def class_name(name: str) -> str:
    """Return the name of a class for a name in small letters: MyCard for my_card."""
    return "".join(part.capitalize() for part in name.split("_"))


def _stage_text(name: str, stage: Configuration) -> str:
    """Return the text of `stage` with the law of NAME.py as controller of the first axis, and without its pre-filter.

    The law gets the keys kp and ki_per_s of the axis's controller if that is the shipped controller "pid". A missing
    ki_per_s becomes SLOW_KI_PER_S; a missing kp is left to the law's default.
    """
    from rtloop.design.stale_comments import remove_first_comments
    from rtloop.design.toml_text import edit_text

    table = tomllib.loads(stage.text)
    axis = table["axis"][0]
    old: dict[str, object] = axis.get("controller", {})
    gains = {key: old[key] for key in ("kp", "ki_per_s") if key in old} if old.get("kind") == "pid" else {}
    axis.pop("prefilter", None)
    axis["controller"] = {"file": f"{name}.py", "ki_per_s": SLOW_KI_PER_S, **gains}
    comments = [
        f"Controller: the law in {name}.py. Stage: that of {stage.source}. To check this file: rtloop check {name}.toml"
    ]
    return edit_text(remove_first_comments(stage.text), table, comments, ["controller"])
