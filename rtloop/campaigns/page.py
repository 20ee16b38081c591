"""The report of a campaign as one self-contained HTML page: yield, figures, pictures, worst rigs. No script."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
import numpy.typing as npt

from rtloop.campaigns.campaign_file import SEPARATOR
from rtloop.campaigns.case import NOMINAL
from rtloop.campaigns.comparison import Comparison
from rtloop.campaigns.pictures import (
    DRAWN_RIGS,
    FigureValues,
    KeyValues,
    RigPlane,
    draw_histogram,
    draw_motions,
    draw_pairs,
    draw_rigs,
    draw_sensitivity,
    histogram_title,
    read_motion,
)
from rtloop.campaigns.store import CRASHED, FAILED, PASSED, REFUSED, RESULTS, read_columns, read_manifest
from rtloop.campaigns.summary import CampaignSummary, Yield
from rtloop.foundation.arrays import Real
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.run_readers import run_files
from rtloop.recording.load import load
from rtloop.values import count_text, render_page

Columns = Mapping[str, np.ndarray]
"""Columns of results, (rigs,) each, by name."""
Link = Callable[[Path], str]
"""Function that returns the path of a file relative to the folder of the page."""
LISTED_RIGS = 500
"""Most crashed, and most refused, rigs that are listed."""
NAMED_KEYS = 3
"""Most keys whose importance is named."""
NOMINAL_TEXTS = {PASSED: "passes", FAILED: "fails", REFUSED: "cannot run", CRASHED: "crashes its worker"}


class RankedKeys(NamedTuple):
    """Keys by their importance for passing, the most important first, and a sentence that names the measure."""

    keys: Sequence[str]
    measure: str


def render_campaign(folder: Path, summary: CampaignSummary, link: Link) -> str:
    """Return the report of the results in `folder` as one HTML page.

    `summary` describes the same results; `link` returns a file's path relative to the folder of the page. Raises
    InputFileError for a folder without results or with damaged ones, MissingExtra without pyarrow or matplotlib.
    """
    section = _campaign_section(folder, summary, link)
    return _render(f"{summary.name}: campaign", [section], None)


def render_comparison(
    folders: Sequence[Path], summaries: Sequence[CampaignSummary], comparison: Comparison, link: Link
) -> str:
    """Return the comparison of two campaigns, followed by the report of each, as one HTML page.

    `summaries` are in the order of `folders`; `link`, and the errors, are as in `render_campaign`.
    """
    sections = [_campaign_section(folder, summary, link) for folder, summary in zip(folders, summaries, strict=True)]
    compared = {"result": comparison, "picture": _pairs_picture(folders)}
    return _render(f"{' and '.join(comparison.names)}: campaigns on the same rigs", sections, compared)


def _render(title: str, sections: Sequence[Mapping[str, object]], comparison: Mapping[str, object] | None) -> str:
    """Return the HTML page of campaigns, given by `sections` as `_campaign_section` returns them.

    `comparison` has the result of a comparison and its picture: {result, picture}; None without a comparison.
    """
    return render_page(
        __package__,
        title=title,
        campaigns=sections,
        comparison=comparison,
        value=value_text,
        count=count_text,
        percent=percent_text,
        yield_text=yield_text,
        most_listed=LISTED_RIGS,
        most_drawn=DRAWN_RIGS,
    )


def value_text(value: object) -> str:
    """Return a value of a key or figure as text: a float with four significant digits, "–" for None and NaN.

    An infinite number is "∞" or "−∞", a truth value "true" or "false"; whole numbers and texts stay as they are.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return "–"
    if isinstance(value, bool):
        return "true" if value else "false"
    if not isinstance(value, float):
        return str(value)
    if np.isinf(value):
        return "∞" if value > 0 else "−∞"
    return f"{float(f'{value:.4g}'):.0f}" if 1e4 <= abs(value) < 1e7 else f"{value:.4g}"


def percent_text(share: float) -> str:
    """Return a share, 0 … 1, in percent with four significant digits, without "%".

    0 and 1 become "0" and "100". A share below 1 gets as many digits as it needs not to read as 100.
    """
    texts = [f"{100 * share:#.{digits}g}" for digits in range(4, 17)]
    return f"{100 * share:g}" if share in (0, 1) else next((t for t in texts if t[:3] != "100"), texts[-1])


def yield_text(estimate: Yield) -> str:
    """Return a sentence with the yield of rigs and its interval; for 0 rigs, one that says that there is no yield."""
    if not estimate.rigs:
        return "No rig could run, so that there is no yield."
    return (
        f"{estimate.passed:,} of {count_text(estimate.rigs, 'rig')} pass: yield {percent_text(estimate.share)} %, "
        f"95 % interval {percent_text(estimate.low)} … {percent_text(estimate.high)} %."
    )


def _estimate_text(sampling: str, estimate: Yield, rigs: int) -> str:
    """Return sentences on the quantity that the yield estimates and on its interval, by the rule of `sampling`.

    `rigs` is the number of all sampled rigs, of which `estimate` counts only some for "saltelli".
    """
    text = (
        "The yield estimates the share of rigs that pass, among all rigs that are drawn from these distributions. "
        "Refused rigs, whose configuration cannot run, do not count. The interval is that of Clopper and Pearson (1934)"
    )
    if sampling == "random":
        return f"{text}: this interval contains the true share in at least 95 % of campaigns."
    independent = (
        f" The yield counts only rigs that are independent of each other: {estimate.rigs:,} of "
        f"{count_text(rigs, 'rig')}."
        if sampling == "saltelli"
        else ""
    )
    return f'{text}. With sampling = "{sampling}" rigs depend on each other: the interval is only a guide.{independent}'


def _campaign_section(folder: Path, summary: CampaignSummary, link: Link) -> dict[str, object]:
    """Return the template's values for one campaign by name, its pictures included; raises as `render_campaign`."""
    manifest, columns = read_manifest(folder), read_columns(folder)
    sampled = _select(columns, columns["rig"] != NOMINAL)
    runnable = _select(sampled, sampled["status"] != REFUSED)
    keys, limits = manifest["keys"], manifest["limits"]
    names = abbreviate_keys(keys)
    figures = [_figure_values(runnable, name, limits[name], summary.nominal) for name in limits]
    quantities = [name for name in ("passed", *limits) if name in summary.sensitivity]
    indices = {
        quantity: {names[key]: index for key, index in summary.sensitivity[quantity].items()} for quantity in quantities
    }
    ranked = rank_keys(keys, runnable, summary)
    return {
        "summary": summary,
        "digest": manifest["digest"],
        "nominal": _nominal_text(summary.nominal),
        "results": _address(link(folder / RESULTS)),
        "estimate": _estimate_text(manifest["sampling"], summary.yield_of_rigs, len(sampled["rig"])),
        "limits": limits,
        "keys": [(key, summary.nominal.get(key), _range_text(sampled[key])) for key in keys],
        "names": names,
        "causes": sorted(summary.causes.items(), key=lambda item: (-item[1], item[0])),
        "histograms": [(values.name, histogram_title(values), draw_histogram(values)) for values in figures],
        "rigs": _rigs_picture(ranked.keys, names, runnable, summary),
        "measure": ranked.measure,
        "runnable": len(runnable["rig"]),
        "sensitivity": draw_sensitivity(indices) if indices else None,
        "crashed": [(rig, "the worker process died each time that this rig ran") for rig in summary.crashed],
        "worst": [
            (rig, *_recordings_picture(folder, rig.rig, manifest["figures"], link))
            for rig in summary.worst_rigs
            if rig.ratio > 0
        ],
    }


def _nominal_text(nominal: Mapping[str, Any]) -> str:
    """Return the nominal rig's verdict as a sentence, with the reasons if it failed or was refused; "" without one.

    `nominal` is its row of results by column, {} without one.
    """
    if not nominal:
        return ""
    reasons = f": {nominal['missed']}" if nominal["status"] in (FAILED, REFUSED) else ""
    return f"The nominal rig, with the configuration's own values, {NOMINAL_TEXTS[nominal['status']]}{reasons}."


def _address(path: str) -> str:
    """Return the URL of a relative path: all bytes but letters, digits and "/_.-~" are percent-encoded."""
    return quote(os.fsencode(path))


def _select(columns: Columns, is_selected: npt.NDArray[np.bool_ | np.intp]) -> dict[str, np.ndarray]:
    """Return the columns of the selected rigs: `is_selected` has truth values (rigs,), or indices, in this order."""
    return {name: values[is_selected] for name, values in columns.items()}


def _figure_values(columns: Columns, name: str, limit: float, nominal: Mapping[str, Any]) -> FigureValues:
    """Return a figure's column as floats, with its limit and the nominal rig's value (NaN if it has none)."""
    value = nominal.get(name)
    return FigureValues(name, columns[name].astype(float), limit, np.nan if value is None else value)


def _range_text(values: np.ndarray) -> str:
    """Return "LEAST … LARGEST, median MEDIAN" for numbers (rigs,), or a list of the different texts or truth values.

    Returns "–" without a value.
    """
    if not len(values):
        return "–"
    if not _is_numeric(values):
        return ", ".join(sorted({value_text(value) for value in values}))
    low, median, high = (value_text(value) for value in (values.min(), np.median(values), values.max()))
    return f"{low} … {high}, median {median}"


def abbreviate_keys(keys: Sequence[str]) -> dict[str, str]:
    """Return a short name by key: its last n parts between dots, for the least n with which all names differ."""
    for count in range(1, max((key.count(".") for key in keys), default=0) + 2):
        names = {key: ".".join(key.split(".")[-count:]) for key in keys}
        if len(set(names.values())) == len(keys):
            return names
    return {key: key for key in keys}


def rank_keys(keys: Sequence[str], columns: Columns, summary: CampaignSummary) -> RankedKeys:
    """Return the keys by their importance for passing; `columns` are of the rigs that could run.

    The measure is the total sensitivity index if it is finite for all keys, else the largest difference between the
    distributions of a key among passed and among failed rigs (Hornberger and Spear 1981, by the distance of Kolmogorov
    and Smirnov). Without the index, and if all rigs pass or none does, the keys keep their order.
    """
    totals = {key: index.total for key, index in summary.sensitivity.get("passed", {}).items()}
    passed = columns["status"] == PASSED
    if totals and np.isfinite(list(totals.values())).all():
        ranked = sorted(keys, key=lambda key: -totals[key])
        return RankedKeys(ranked, "the keys with the largest total sensitivity index for passing")
    if not passed.any() or passed.all():
        return RankedKeys(keys, f"the first keys of the campaign, as {'all' if passed.any() else 'no'} rigs pass")
    numbers = {key: _key_numbers(columns[key])[0] for key in keys}
    distances = {key: _distribution_distance(numbers[key][passed], numbers[key][~passed]) for key in keys}
    ranked = sorted(keys, key=lambda key: -distances[key])
    names = abbreviate_keys(keys)
    distance_texts = ", ".join(f"{names[key]} {value_text(distances[key])}" for key in ranked[:NAMED_KEYS])
    measure = "the keys whose distributions differ most between passed and failed rigs"
    return RankedKeys(ranked, f"{measure} (largest difference: {distance_texts})")


def _distribution_distance(first: Real, second: Real) -> float:
    """Return the largest difference between the distribution functions of two samples (n,) and (m,), neither of them
    empty.
    """
    values = np.concatenate([first, second])
    shares = (np.searchsorted(np.sort(sample), values, "right") / sample.size for sample in (first, second))
    return float(np.max(np.abs(np.subtract(*shares))))


def _is_numeric(values: npt.NDArray[np.generic]) -> bool:
    """Whether values (rigs,) of a key are numbers, and neither texts nor truth values."""
    return values.dtype.kind in "iuf"


def _key_numbers(values: npt.NDArray[np.generic]) -> tuple[Real, tuple[str, ...]]:
    """Return values (rigs,) of a key as floats, and the texts for which the numbers 0, 1 … stand.

    The texts are sorted, truth values are "false" and "true"; there are no texts, (), if the values are numbers.
    """
    if _is_numeric(values):
        return values.astype(float), ()
    texts, numbers = np.unique([value_text(value) for value in values], return_inverse=True)
    return numbers.astype(float), tuple(map(str, texts))


def _rigs_picture(
    ranked: Sequence[str], names: Mapping[str, str], columns: Columns, summary: CampaignSummary
) -> dict[str, bytes] | None:
    """Return the picture, as PNG bytes by theme, of rigs over the first two `ranked` keys; None without rigs.

    A single key is drawn over the rig's number. `names` has the short name of each key; `columns` are of the rigs that
    could run.
    """
    if not len(columns["rig"]):
        return None
    axes = []
    for key in ranked[:2]:
        numbers, texts = _key_numbers(columns[key])
        nominal = summary.nominal.get(key)
        if texts:
            nominal = texts.index(value_text(nominal)) if value_text(nominal) in texts else None
        axes.append(KeyValues(names[key], numbers, np.nan if nominal is None else float(nominal), texts))
    if len(axes) < 2:
        axes.append(KeyValues("rig", columns["rig"].astype(float), float(NOMINAL)))
    return draw_rigs(RigPlane(axes[0], axes[1], columns["status"] == PASSED))


def _recordings_picture(
    folder: Path, rig: int, figures: Sequence[str], link: Link
) -> tuple[dict[str, bytes] | None, list[tuple[str, str]], list[str]]:
    """Return the picture of a rig's recordings, (file name, URL) of each file, and the faults of unreadable ones.

    The files are in the folder "worst" of `folder`, one run for each experiment in `figures`, "EXPERIMENT.FIGURE". The
    picture is None without a readable recording.
    """
    labels = dict.fromkeys(figure.partition(SEPARATOR)[0] for figure in figures)
    runs = {label: run_files(folder / "worst" / f"rig-{rig:09d}-{label}.mcap", ".mcap") for label in labels}
    motions, faults = {}, []
    for label, paths in runs.items():
        try:
            if paths:
                motions[label] = read_motion(load(paths))
        except RecordingError as error:
            faults.append(str(error))
    links = [(path.name, _address(link(path))) for paths in runs.values() for path in paths]
    return draw_motions(motions) if motions else None, links, faults


def _pairs_picture(folders: Sequence[Path]) -> dict[str, bytes] | None:
    """Return the picture of each figure with a limit in both campaigns, rig by rig; None without such a figure.

    Drawn are sampled rigs that could run in both of the two `folders`.
    """
    manifests = [read_manifest(folder) for folder in folders]
    tables = [read_columns(folder) for folder in folders]
    tables = [_select(table, (table["rig"] != NOMINAL) & (table["status"] != REFUSED)) for table in tables]
    _, *places = np.intersect1d(tables[0]["rig"], tables[1]["rig"], return_indices=True)
    tables = [_select(table, place) for table, place in zip(tables, places, strict=True)]
    limits = [manifest["limits"] for manifest in manifests]
    pairs = [
        (_figure_values(tables[0], name, limits[0][name], {}), _figure_values(tables[1], name, limits[1][name], {}))
        for name in limits[0]
        if name in limits[1]
    ]
    return draw_pairs(pairs) if pairs else None
