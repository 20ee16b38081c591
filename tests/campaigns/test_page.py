"""The page of a campaign shows the numbers of its Parquet files, needs no other file, and escapes all names."""

from __future__ import annotations

import base64
import dataclasses
import math
import re
import shutil
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pyarrow.parquet
import pytest
from scipy import stats

from rtloop.campaigns.campaign_file import load_campaign
from rtloop.campaigns.case import CaseRunner
from rtloop.campaigns.page import abbreviate_keys, percent_text, rank_keys, value_text
from rtloop.campaigns.pictures import FigureValues, draw_histogram, draw_pairs, histogram_title
from rtloop.campaigns.recorded_case import record_rig
from rtloop.campaigns.sensitivity import SensitivityIndex
from rtloop.campaigns.store import crashed_case, open_store
from rtloop.campaigns.summary import summarise_campaign
from rtloop.campaigns.unit import Unit
from rtloop.design.palette import LIGHT
from tests.campaigns.campaign_files import ROOT, STEPS, write_campaign
from tests.command_line import run

SCAN = """
[[experiment]]
kind = "scan"
amplitude_um = 5.0
frequency_hz = 50.0
periods = 2.0
"""
RIGS, FEW_RIGS = 12, 4
ONE_KEY = '"driver.plant.hysteresis.truth" = { choice = ["nominal", "residual"] }'


class Page(HTMLParser):
    """Tags of a page with their attributes, and its text without tags and with single spaces."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path, self.source, self._texts = path, path.read_text("utf-8"), []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.feed(self.source)
        self.text = " ".join(" ".join(self._texts).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self._texts.append(data)

    def attributes(self, tag: str, name: str) -> list[str]:
        """Return an attribute of each tag of a kind that has it."""
        return [values[name] or "" for kind, values in self.tags if kind == tag and name in values]

    @property
    def pictures(self) -> list[tuple[bytes, bytes]]:
        """The light and the dark PNG of each picture."""
        light, dark = (
            [base64.b64decode(address.partition("base64,")[2]) for address in addresses]
            for addresses in (self.attributes("img", "src"), self.attributes("source", "srcset"))
        )
        return list(zip(light, dark, strict=True))


def make_runner(folder, name="stage", **options) -> CaseRunner:
    """Return the runner of a campaign of RIGS rigs; `without_limits` leaves out the table of limits."""
    without_limits = options.pop("without_limits", False)
    path = write_campaign(folder, **{"keys": f"rigs = {RIGS}", **options})
    path = path.rename(folder / f"{name}.toml")
    if without_limits:
        path.write_text(path.read_text().partition("[limits]")[0])
    return CaseRunner(load_campaign(path))


def store_cases(runner, folder, cases=None) -> Path:
    """Store the nominal rig and all sampled rigs, or the results `cases`. Returns the folder."""
    rigs = runner.options.rigs
    with open_store(folder, runner.campaign, runner.sample_values(0)) as results:
        results.add(Unit(0, 0), [runner.run(0)])
        results.add(Unit(1, rigs), cases or [runner.run(rig) for rig in range(1, rigs + 1)])
    return folder


def make_page(folder, page, *options) -> Page:
    """Write the page of a folder by the command line. Returns the parsed page."""
    result = run("campaign", "report", folder, "--page", page, *options)
    assert result.exit_code in (0, 1), result.output
    assert str(page) in result.stderr
    return Page(page)


def require_complete(page: Page) -> None:
    """Require a page without scripts and external files, with pictures in both themes, whose links exist."""
    assert "<script" not in page.source.lower()
    assert "http" not in "".join(page.attributes("img", "src") + page.attributes("source", "srcset"))[:100]
    assert not re.search(r"""(src|srcset|href)\s*=\s*["']?(https?:|//|file:)""", page.source)
    assert {tag for tag, _ in page.tags} & {"link", "iframe", "object", "script", "embed"} == set()
    for link in page.attributes("a", "href"):
        assert (page.path.parent / unquote(link)).exists(), link
    assert "prefers-color-scheme: dark" in page.source
    for light, dark in page.pictures:
        assert light.startswith(b"\x89PNG")
        assert dark.startswith(b"\x89PNG")
        assert light != dark


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """Runner, folder and worst rig of a campaign: hostile name, some failures, recordings of the worst rig."""
    folder = tmp_path_factory.mktemp("campaign & results")
    runner = make_runner(folder, "a<b>&c", experiments=STEPS + SCAN)
    results = store_cases(runner, folder / "50% of <results>")
    worst_rig = summarise_campaign(results).worst_rigs[0].rig
    record_rig(runner, worst_rig, results / "worst")
    return runner, results, worst_rig


@pytest.fixture(scope="module")
def page(campaign, tmp_path_factory):
    """The page of the campaign, parsed."""
    return make_page(campaign[1], tmp_path_factory.mktemp("pages") / "of a campaign" / "page.html")


@pytest.fixture(scope="module")
def paper(tmp_path_factory):
    """Results of a campaign of the paper's controller."""
    folder = tmp_path_factory.mktemp("paper")
    return store_cases(make_runner(folder), folder / "results")


@pytest.fixture(scope="module")
def robust(tmp_path_factory):
    """Results of a campaign in which no rig fails."""
    folder = tmp_path_factory.mktemp("robust")
    return store_cases(make_runner(folder, configuration=ROOT / "deploy/robust.toml"), folder / "results")


@pytest.fixture
def blank_pictures(monkeypatch):
    """Draw nothing, for tests of the text; the pictures of `page` are drawn."""
    pictures = {"light": b"\x89PNG light", "dark": b"\x89PNG dark"}
    monkeypatch.setattr("rtloop.campaigns.pictures.draw_pictures", lambda *_: pictures)


def result_rows(folder) -> list[dict]:
    """Return the rows of the stored Parquet files."""
    return pyarrow.parquet.read_table(folder / "results").to_pylist()


def test_the_yield_is_that_of_the_parquet_files(campaign, page):
    states = [row["status"] for row in result_rows(campaign[1]) if row["rig"]]
    passed, rigs = states.count("passed"), len(states)
    assert 0 < passed < rigs == RIGS
    low = stats.beta.ppf(0.025, passed, rigs - passed + 1)
    high = stats.beta.ppf(0.975, passed + 1, rigs - passed)
    share, low, high = (f"{100 * value:#.4g}" for value in (passed / rigs, low, high))
    assert f"{passed} of {rigs} rigs pass: yield {share} %, 95 % interval {low} … {high} %." in page.text
    assert "all rigs that are drawn from these distributions" in page.text


def test_the_figures_are_those_of_the_parquet_files(campaign, page):
    sampled = [row for row in result_rows(campaign[1]) if row["rig"]]
    assert len(campaign[0].campaign.limits) == 3
    for name in campaign[0].options.figures:
        values = sorted(row[name] for row in sampled)
        quantiles = [values[math.ceil(share * (RIGS - 1))] for share in (0.05, 0.5, 0.95)]
        limit = campaign[0].campaign.limits.get(name)
        beyond = "–" if limit is None else str(sum(value > limit for value in values))
        nominal = next(row for row in result_rows(campaign[1]) if row["rig"] == 0)[name]
        cells = [name, *map(value_text, [nominal, *quantiles, values[-1], limit]), beyond]
        assert " ".join(cells) in page.text


def test_the_page_is_whole_and_escapes_names(campaign, page):
    require_complete(page)
    assert "a<b>" not in page.source
    assert "a&lt;b&gt;&amp;c-paper" in page.source
    assert "a<b>&c-paper" in page.text


def test_causes_and_worst_rigs_are_listed_with_pictures_of_their_recordings(campaign, page):
    runner, results, worst_rig = campaign
    summary = summarise_campaign(results)
    for cause, count in summary.causes.items():
        assert f"{count} {cause}" in page.text
    for rig in summary.worst_rigs:
        values = [value_text(rig.values[key]) for key in runner.keys]
        assert " ".join([str(rig.rig), value_text(rig.ratio), *values, rig.missed]) in page.text
    recordings = [unquote(link) for link in page.attributes("a", "href") if link.endswith(".mcap")]
    assert [Path(link).name for link in recordings] == [
        f"rig-{worst_rig:09d}-{name}.mcap" for name in ("steps", "scan")
    ]
    assert len(page.pictures) == 3 + 1 + 1
    assert f"rig {worst_rig}: reference and true position" in page.attributes("img", "alt")


def test_a_damaged_recording_is_named_on_the_page(blank_pictures, campaign, tmp_path):
    _, results, worst_rig = campaign
    copy = shutil.copytree(results, tmp_path / "copy", ignore=shutil.ignore_patterns("worst"))
    (copy / "worst").mkdir()
    (copy / "worst" / f"rig-{worst_rig:09d}-scan.mcap").write_bytes(b"<i>nothing</i>")
    page = make_page(copy, tmp_path / "page.html")
    require_complete(page)
    assert re.search(rf"rig-{worst_rig:09d}-scan\.mcap: .* Recordings: rig-{worst_rig:09d}-scan\.mcap", page.text)


def test_a_campaign_without_failures_has_a_page(blank_pictures, robust, tmp_path):
    page = make_page(robust, tmp_path / "page.html")
    require_complete(page)
    assert f"{RIGS} of {RIGS} rigs pass: yield 100 %" in page.text
    assert "as all rigs pass" in page.text
    assert "Causes of failure" not in page.text


def test_a_campaign_without_limits_has_a_page(blank_pictures, tmp_path):
    runner = make_runner(tmp_path, experiments=SCAN, without_limits=True, uncertain=ONE_KEY)
    results = store_cases(runner, tmp_path / "results")
    page = make_page(results, tmp_path / "page.html")
    require_complete(page)
    assert "The campaign has no limits: a rig fails by a trip alone." in page.text
    assert "the campaign has no limits: a rig fails by a trip alone" in run("campaign", "report", results).stdout
    assert "nominal, residual" in page.text
    assert len(page.pictures) == 1


def test_crashed_and_refused_rigs_are_listed_with_their_reasons(blank_pictures, tmp_path):
    runner = make_runner(tmp_path, keys=f"rigs = {FEW_RIGS}")
    cases = [runner.run(rig) for rig in range(1, FEW_RIGS)]
    fields = {"figures": {}, "trips": {}, "missed": (), "ratio": math.nan}
    cases[-1] = dataclasses.replace(cases[-1], **fields, refusal="<u>no rig</u>")
    cases.append(crashed_case(FEW_RIGS, runner.sample_values(FEW_RIGS)))
    page = make_page(store_cases(runner, tmp_path / "results", cases), tmp_path / "page.html")
    require_complete(page)
    assert f"{FEW_RIGS - 1} <u>no rig</u>" in page.text
    assert "<u>" not in page.source
    assert f"{FEW_RIGS} the worker process died" in page.text
    assert "1 crashed, which counts as failed, and 1 could not run, which does not count." in page.text
    assert f"of {FEW_RIGS - 1} rigs pass" in page.text


def test_a_campaign_whose_rigs_cannot_run_has_a_page(blank_pictures, tmp_path):
    runner = make_runner(tmp_path, keys="rigs = 1")
    fields = {"figures": {}, "trips": {}, "missed": (), "ratio": math.nan}
    refused = dataclasses.replace(runner.run(1), **fields, refusal="no rig")
    page = make_page(store_cases(runner, tmp_path / "results", [refused]), tmp_path / "page.html")
    require_complete(page)
    assert "No rig could run, so that there is no yield." in page.text


def test_saltellis_design_shows_indices_and_counts_its_independent_rows(blank_pictures, tmp_path):
    runner = make_runner(tmp_path, keys='rigs = 20\nsampling = "saltelli"', configuration=ROOT / "deploy/robust.toml")
    page = make_page(store_cases(runner, tmp_path / "results"), tmp_path / "page.html")
    require_complete(page)
    assert "8 of 8 rigs pass" in page.text
    assert 'With sampling = "saltelli" rigs depend on each other: the interval is only a guide.' in page.text
    assert "The yield counts only rigs that are independent of each other: 8 of 20 rigs." in page.text
    assert "sensitivity indices by key" in page.attributes("img", "alt")


def test_two_campaigns_are_compared_on_one_page(blank_pictures, paper, robust, tmp_path):
    path = tmp_path / "comparison.html"
    assert run("campaign", "compare", paper, robust, "--page", path).exit_code == 0
    page = Page(path)
    require_complete(page)
    passed = [
        {row["rig"] for row in result_rows(folder) if row["rig"] and row["status"] == "passed"}
        for folder in (paper, robust)
    ]
    passed_alone = [len(passed[0] - passed[1]), len(passed[1] - passed[0])]
    assert f"Passed by stage-paper alone: {passed_alone[0]}; by stage-robust alone: {passed_alone[1]}." in page.text
    assert "First campaign: stage-paper" in page.text
    assert "Second campaign: stage-robust" in page.text


def test_a_run_writes_its_page(blank_pictures, tmp_path):
    path = write_campaign(tmp_path, keys="rigs = 2")
    result = run("campaign", "run", path, "--out", tmp_path / "out", "--jobs", 1, "--page", tmp_path / "page.html")
    assert result.exit_code in (0, 1), result.output
    require_complete(Page(tmp_path / "page.html"))


def test_without_matplotlib_the_report_names_the_extra(campaign, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    result = run("campaign", "report", campaign[1], "--page", tmp_path / "page.html")
    assert result.exit_code == 78
    assert "pip install 'rtloop[plot]'" in result.stderr
    assert not (tmp_path / "page.html").exists()


def test_numbers_have_four_significant_digits():
    values = [
        1.0,
        0.123456,
        123456.0,
        1e-9,
        math.inf,
        -math.inf,
        math.nan,
        None,
        True,
        np.int64(12345678),
        np.True_,
        "a",
    ]
    texts = ["1", "0.1235", "123500", "1e-09", "∞", "−∞", "–", "–", "true", "12345678", "true", "a"]
    assert [value_text(value) for value in values] == texts
    shares = [0.0, 1.0, 0.28, 0.99996, 1 - 1e-9, 1 - 2**-53]
    assert [percent_text(share) for share in shares] == [
        "0",
        "100",
        "28.00",
        "99.996",
        "99.9999999",
        "99.99999999999999",
    ]


def test_short_names_tell_keys_apart():
    assert abbreviate_keys(["a.b.gain", "a.b.shift"]) == {"a.b.gain": "gain", "a.b.shift": "shift"}
    assert abbreviate_keys(["axis.x.gain", "axis.y.gain"]) == {"axis.x.gain": "x.gain", "axis.y.gain": "y.gain"}
    assert abbreviate_keys(["gain", "x.gain"]) == {"gain": "gain", "x.gain": "x.gain"}
    assert abbreviate_keys(["gain"]) == {"gain": "gain"}


def test_a_key_that_fails_rigs_at_both_ends_comes_first(campaign):
    """Medians of passed and failed rigs are equal for such a key: the distributions are compared."""
    summary = dataclasses.replace(summarise_campaign(campaign[1]), sensitivity={})
    generator = np.random.default_rng(3)
    shift, noise, kind = generator.uniform(-1, 1, 400), generator.uniform(size=400), generator.choice(["a", "b"], 400)
    status = np.where(np.abs(shift) < 0.5, "passed", "failed")
    columns = {"other": noise, "kind": kind, "shift": shift, "status": status}
    ranked = rank_keys(["other", "kind", "shift"], columns, summary)
    assert ranked.keys[0] == "shift"
    assert re.search(r"largest difference: shift 0\.[45]\d+,", ranked.measure)
    distance, _ = stats.ks_2samp(shift[status == "passed"], shift[status == "failed"])
    assert f"shift {distance:.4g}" in ranked.measure


def test_total_indices_rank_keys_where_they_exist(campaign):
    index = {key: SensitivityIndex(0.0, 0.0, 0.0, total, 0.0, 0.0) for key, total in (("a", 0.1), ("b", 0.7))}
    summary = dataclasses.replace(summarise_campaign(campaign[1]), sensitivity={"passed": index})
    columns = {"a": np.arange(4.0), "b": np.arange(4.0), "status": np.array(["passed", "failed"] * 2)}
    assert rank_keys(["a", "b"], columns, summary).keys == ["b", "a"]


VALUES = [
    [],
    [0.0, 0.0],
    [1.0],
    [1.0, 1.0 + 1e-16],
    [math.inf, math.nan],
    [1e-9, 1e9],
    [0.0, 3.0, math.inf],
    [5.0, 5.0],
]
LIMITS = [0.0, 5.0, 1e9, math.inf]


@pytest.mark.parametrize(
    ("values", "limit"),
    [(values, LIMITS[i % len(LIMITS)]) for i, values in enumerate(VALUES)]
    + [(values, limit) for values in ([1e-9, 1e9], [5.0, 5.0]) for limit in LIMITS[2:]],
)
def test_a_figure_has_a_picture(monkeypatch, values, limit):
    """In one theme: the pictures of `page` have both."""
    monkeypatch.setattr("rtloop.design.palette.THEMES", {"light": LIGHT})
    require_pictures(values, limit)


@pytest.mark.soak
@pytest.mark.parametrize("values", VALUES)
@pytest.mark.parametrize("limit", LIMITS)
def test_every_figure_has_a_picture(values, limit):
    """All pairs of values and limits; one picture takes a quarter of a second."""
    require_pictures(values, limit)


def require_pictures(values, limit):
    """Require a histogram and a picture of pairs."""
    figure = FigureValues("a $x$ <b>", np.array(values), limit, math.inf)
    assert draw_histogram(figure)["light"].startswith(b"\x89PNG")
    assert draw_pairs([(figure, figure)])["light"].startswith(b"\x89PNG")


@pytest.mark.parametrize(("outliers", "text"), [
    ([60.0, 812.0], "100 rigs; 2 rigs lie beyond this axis, up to 812"), ([10.0, 10.0], "100 rigs"),
])  # fmt: skip
def test_outliers_lie_beyond_the_axis_of_a_histogram_and_are_counted(outliers, text):
    """98 values between 4 and 4.97; the axis reaches the limit, 12."""
    figure = FigureValues("a", np.append(4 + 0.01 * np.arange(98), outliers), 12.0, 4.1)
    assert histogram_title(figure) == text


def test_infinite_values_are_counted_in_words():
    values = np.array([1.0, math.inf, 2.0, math.inf, math.nan])
    assert histogram_title(FigureValues("a", values, 1.0, 1.0)) == "2 rigs; 2 more rigs have an infinite value"
    assert histogram_title(FigureValues("a", values[:2], 1.0, math.inf)) == (
        "1 rig; 1 more rig has an infinite value; the nominal rig has an infinite value"
    )
