"""`/api/measure`: exact figures of all ticks between two cursors."""

from __future__ import annotations

import asyncio

import numpy as np
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from rtloop.panel.feed.feed import Feed
from rtloop.panel.web.responses import RequestRefused, with_error_responses

MAX_SIGNALS = 8


def signal_figures(feed: Feed, run: int, first: int, end: int, signals: list[str]) -> dict[str, dict[str, float]]:
    """Return {signal: {rms, mean, std, low, high, peak_to_peak}} over ticks `first` … `end` − 1, in the signal's unit.

    `low` and `high` are the least and the largest value. Lost ticks are left out. Raises RequestRefused (410) for ticks
    that are no longer or not yet in memory, of another run, or all lost, and for a signal without a finite value in
    them; ValueError for no signal, more than MAX_SIGNALS or an unknown one, and for an `end` that is not above `first`.
    """
    if not 0 < len(signals) <= MAX_SIGNALS:
        raise ValueError(f"signals: {len(signals)} names; allowed: 1 to {MAX_SIGNALS}")
    if not first < end:
        raise ValueError(f"end: {end}; allowed: above {first}, the value of `first`")
    with feed.lock:
        past = feed.past
        if past is None or past.run != run or first < past.begin or end > past.end:
            raise RequestRefused(
                410,
                f"ticks {first} to {end - 1}: not in memory, which holds the newest ticks only; select newer ticks, or "
                "open the recording",
            )
        *values, ticks = past.values([*signals, "tick"], first, end)
    span = f"ticks {first} to {end - 1}"
    if not np.isfinite(ticks).any():
        raise RequestRefused(
            410,
            f"{span}: lost before the panel read these ticks; a recording of the run is not affected; select another "
            "range",
        )
    results = {}
    for name, row in zip(signals, values, strict=True):
        samples = row[np.isfinite(row)]
        if samples.size == 0:
            raise RequestRefused(410, f"{span}: {name} has no finite value; select another range or signal")
        low, high = float(samples.min()), float(samples.max())
        results[name] = {
            "rms": float(np.sqrt(np.mean(samples**2))),
            "mean": float(samples.mean()),
            "std": float(samples.std()),
            "low": low,
            "high": high,
            "peak_to_peak": high - low,
        }
    return results


@with_error_responses
async def measure(feed: Feed, request: Request) -> Response:
    """Respond to `/api/measure?run=R&first=TICK&end=TICK&signals=a,b` with `signal_figures`; errors become JSON."""
    query = request.query_params
    run, first, end = (_integer(name, query.get(name, "")) for name in ("run", "first", "end"))
    signals = query.get("signals", "").split(",")
    return JSONResponse(await asyncio.to_thread(signal_figures, feed, run, first, end, signals))


def _integer(name: str, text: str) -> int:
    """Return the integer in the query value `name`. Raises ValueError for other text, or over 15 characters."""
    if not (text.removeprefix("-").isdigit() and text.isascii() and len(text) < 16):
        raise ValueError(f"{name}: {text[:40]!r}; allowed: whole numbers")
    return int(text)
