"""The histogram of a latency measurement as a PNG."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from rtloop.doctor.examine import Latency
from rtloop.errors import output_errors
from rtloop.foundation.trusted import overwrite_file
from rtloop.recording.views.picture import DOTS_PER_INCH, create_picture

FINEST_US = 0.01


def draw_histogram(latency: Latency, target: Path) -> None:
    """Draw the histogram of the lateness, with quantiles and the period, to the PNG `target`, which is replaced.

    Raises OutputError if the system refuses, MissingExtra without matplotlib.
    """
    figure = create_picture(8, 4.5)
    values_us = np.maximum(latency.lateness_us, FINEST_US)
    edges = np.geomspace(FINEST_US, max(values_us.max(), latency.period_us) * 1.1, 120)
    panel = figure.add_subplot()
    panel.hist(values_us, edges, color="tab:blue")
    panel.set_xscale("log")
    panel.set_yscale("log", nonpositive="clip")
    panel.set_ylim(0.7)
    for share, style in ((0.5, "-"), (0.99, "--"), (0.999, ":")):
        quantile_us = latency.quantile_us(share)
        label = f"p{100 * share:g}: {quantile_us:.3g} µs"
        panel.axvline(max(quantile_us, FINEST_US), color="0.2", linestyle=style, linewidth=1.0, label=label)
    panel.axvline(latency.period_us, color="tab:red", label=f"period: {latency.period_us:g} µs")
    pacing = latency.pacing
    panel.set_xlabel("lateness / µs")
    panel.set_ylabel("ticks")
    panel.set_title(f"{latency.lateness_us.size:,} ticks at {pacing.rate_hz:g} Hz, spinning {pacing.spin_us:g} µs")
    panel.grid(visible=True, alpha=0.3)
    panel.legend()
    with output_errors(target), os.fdopen(overwrite_file(target), "wb") as file:
        figure.savefig(file, format="png", dpi=DOTS_PER_INCH)
