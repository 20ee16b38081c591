"""Differences between an axis's options before and after a change, in words: `controller.gain 0.016 → 0.012`."""

from __future__ import annotations

from collections.abc import Iterator

from rtloop.configuration.axis import AxisOptions

MAX_WRITTEN = 3
"""Most differences that are written out; the others are counted."""


def differences(before: AxisOptions, after: AxisOptions) -> str:
    """Return the keys that differ, each as `_section_differences` writes it, as one text; "" for equal options.

    At most MAX_WRITTEN keys are written out; for more, the text ends with the number of the others.
    """
    tables = before.model_dump(mode="json"), after.model_dump(mode="json")
    texts = [
        text for section in tables[0] for text in _section_differences(section, tables[0][section], tables[1][section])
    ]
    omitted_text = f", and {len(texts) - MAX_WRITTEN} more" if len(texts) > MAX_WRITTEN else ""
    return ", ".join(texts[:MAX_WRITTEN]) + omitted_text


def _section_differences(section: str, before: object, after: object) -> Iterator[str]:
    """Yield a text for each key that differs between two values of `section`, such as "limits.drive_v 10 → 9".

    A key whose value is a list or table gets "SECTION.KEY changed". Yield one text, "SECTION BEFORE → AFTER", if one of
    the two values of the section is no table, and with the two kinds alone if their kinds differ. Yield nothing for
    equal values.
    """
    if before == after:
        return
    if not (isinstance(before, dict) and isinstance(after, dict)):
        yield f"{section} {_format_value(before)} → {_format_value(after)}"
    elif before.get("kind") != after.get("kind"):
        yield f"{section} {before.get('kind')} → {after.get('kind')}"
    else:
        for key in before | after:
            old, new = before.get(key), after.get(key)
            if old == new:
                continue
            is_long = isinstance(old, list | dict) or isinstance(new, list | dict)
            yield f"{section}.{key} " + ("changed" if is_long else f"{_format_value(old)} → {_format_value(new)}")


def _format_value(value: object) -> str:
    """Return a value as a short text: six digits of a number, "none" for None, "a table" for a dict, else its str."""
    if isinstance(value, float | int) and not isinstance(value, bool):
        return f"{value:.6g}"
    return "none" if value is None else "a table" if isinstance(value, dict) else str(value)
