"""Held-out errors of a model of the hysteresis: rows of the report, and comments of the written section."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rtloop.design.identification.hysteresis.judgement import Judgement


def judgement_row(judgement: Judgement, fitted: bool) -> dict[str, object]:
    """Return the report's row on the model's held-out error in one recording, which is `fitted` or validates only.

    Keys: recording (name), fitted, rms_error_um, as_written_rms_um (of the plays alone), max_error_um, range_um (of the
    position), max_error_percent (of this range), offset_um (in its last stretch), drift_um (over its duration), memory
    ("rest" or "unknown"), known_from_s (time from which the memory of the hysteresis is known, None: never), unsettled
    (whether its beginning departs from a periodic loop), unsettled_um (by how much), judged_percent (part with known
    memory), early_max_error_percent (of the other part). Errors are NaN where their part is empty.
    """
    return {
        "recording": judgement.name,
        "fitted": fitted,
        "rms_error_um": judgement.rms_um,
        "as_written_rms_um": judgement.rms_of_plays_um,
        "max_error_um": judgement.max_um,
        "max_error_percent": 100 * judgement.max_um / judgement.range_um,
        "range_um": judgement.range_um,
        "offset_um": judgement.offset_um,
        "drift_um": judgement.drift_um,
        "memory": "rest" if judgement.starts_from_rest else "unknown",
        "known_from_s": judgement.known_from_s,
        "unsettled": judgement.is_unsettled,
        "unsettled_um": judgement.unsettled_um,
        "judged_percent": 100 * judgement.known_share,
        "early_max_error_percent": 100 * judgement.early_max_um / judgement.range_um,
    }


def validation_comments(rows: Sequence[Mapping[str, Any]], extra: Mapping[str, Any]) -> list[str]:
    """Return comment lines for the model's section of a configuration.

    The first states the largest held-out error of `rows` (of `judgement_row`; one at least has a judged part). From
    `extra`, fields that only recordings with unknown memory have, follow lines on the effects left out of the model,
    such as creep, and, if plays may be missing, on the largest stroke, V, for which the model is valid.
    """
    worst_row = max((row for row in rows if row["judged_percent"]), key=lambda row: row["max_error_percent"])
    name, memory = Path(worst_row["recording"]).name, worst_row["memory"]
    lines = [
        f"largest held-out error, in {name}: {worst_row['rms_error_um']:.3g} µm rms, at most "
        f"{worst_row['max_error_percent']:.3g} % of the range of {worst_row['range_um']:.4g} µm. Memory of the "
        f"hysteresis at the start: {memory}; {worst_row['judged_percent']:.3g} % of this recording was judged"
    ]
    play_errors_um = [row["as_written_rms_um"] for row in rows if math.isfinite(row["as_written_rms_um"])]
    if extra.get("terms") and play_errors_um:
        lines.append(
            f"the fit also modelled {' and '.join(extra['terms'])}, which this section leaves out; the plays of this "
            f"section alone leave an error of up to {max(play_errors_um):.3g} µm rms"
        )
    if extra.get("missing"):
        lines.append(f"this model is valid for strokes of up to {extra['stroke_v']:.4g} V; {extra['missing']}")
    return lines
