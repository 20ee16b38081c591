"""What lies between two cursors: exact figures of every tick there, which no envelope knows."""

from __future__ import annotations

import asyncio

import numpy as np
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from rtloop.panel.views.feed import Feed

MAX_SIGNALS = 8


class TicksUnavailable(Exception):
    """The ticks are not kept any more, or not yet there."""


def signal_figures(feed: Feed, run: int, first: int, end: int, signals: list[str]) -> dict[str, dict[str, float]]:
    """Of ticks `first` … `end` − 1, those that were lost left out. Raises Gone, and ValueError for bad requests."""
    if not 0 < len(signals) <= MAX_SIGNALS:
        raise ValueError(f"signals: {len(signals)} are asked for; 1 to {MAX_SIGNALS} are allowed")
    if not first < end:
        raise ValueError(f"end: {end}; more than first, {first}, is needed")
    with feed.lock:
        past = feed.past
        if past is None or past.run != run or first < past.begin or end > past.end:
            raise TicksUnavailable("these ticks are not kept any more")
        values = past.values(signals, first, end)
    results = {}
    for name, row in zip(signals, values, strict=True):
        samples = row[np.isfinite(row)]
        if samples.size == 0:
            raise TicksUnavailable("these ticks are lost")
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


async def measure(feed: Feed, request: Request) -> Response:
    """`/api/measure?run=R&first=TICK&end=TICK&signals=a,b`."""
    query = request.query_params
    try:
        run, first, end = (_integer(name, query.get(name, "")) for name in ("run", "first", "end"))
        signals = query.get("signals", "").split(",")
        return JSONResponse(await asyncio.to_thread(signal_figures, feed, run, first, end, signals))
    except TicksUnavailable as error:
        return JSONResponse({"error": str(error)}, status_code=410)
    except ValueError as error:
        return JSONResponse({"error": str(error)}, status_code=422)


def _integer(name: str, text: str) -> int:
    if not (text.removeprefix("-").isdigit() and text.isascii() and len(text) < 16):
        raise ValueError(f"{name}: {text[:40]!r}; a whole number is needed")
    return int(text)
