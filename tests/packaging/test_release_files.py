"""News fragments, changelog, citation file and workflows are complete and consistent for a release."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib

import pytest

from tests.packaging.distribution import ROOT

NEWS = ROOT / "docs/news"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
KINDS = {kind["directory"] for kind in PROJECT["tool"]["towncrier"]["type"]}


def test_each_fragment_of_news_has_a_known_kind_and_a_sentence():
    fragments = [file for file in NEWS.iterdir() if file.name != "README.md"]
    assert [file.name for file in fragments if not re.fullmatch(rf"\+[\w-]+\.({'|'.join(KINDS)})\.md", file.name)] == []
    assert [file.name for file in fragments if not file.read_text(encoding="utf-8").strip().endswith((".", ")"))] == []


def test_the_page_of_news_names_every_kind():
    assert set(re.findall(r"`\+NAME\.(\w+)\.md`", (NEWS / "README.md").read_text(encoding="utf-8"))) == KINDS


def test_news_begin_below_the_introduction_of_the_changelog():
    changelog = (ROOT / PROJECT["tool"]["towncrier"]["filename"]).read_text(encoding="utf-8")
    introduction, _, sections = changelog.partition(PROJECT["tool"]["towncrier"]["start_string"])
    assert introduction.startswith("# Changelog")
    assert "\n## " not in introduction
    assert sections.lstrip().startswith("## ")


def test_a_draft_of_the_news_holds_every_fragment():
    pytest.importorskip("towncrier", reason="towncrier is missing: `make news` installs it")
    command = [sys.executable, "-m", "towncrier", "build", "--draft", "--version", "9.9.9"]
    completed = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert completed.returncode == 0, completed.stderr
    assert "## 9.9.9 (" in completed.stdout
    printed = " ".join(completed.stdout.split())
    for file in NEWS.glob("+*.md"):
        assert " ".join(file.read_text(encoding="utf-8").split()) in printed


def test_the_citation_names_software_licence_and_paper():
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    for line in ("cff-version: 1.2.0", "type: software", f"license: {PROJECT['project']['license']}"):
        assert f"\n{line}\n" in f"\n{text}"
    for name in ("Rakotondrabe", "Aljanaideh", "Al Janaideh"):
        assert f"family-names: {name}\n" in text


def test_actions_of_workflows_are_named_by_commit_and_version():
    workflows = list((ROOT / ".github/workflows").glob("*.yml"))
    uses = [line for file in workflows for line in file.read_text(encoding="utf-8").splitlines() if "uses:" in line]
    assert uses
    assert [line for line in uses if not re.search(r"uses: [\w./-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+$", line)] == []
