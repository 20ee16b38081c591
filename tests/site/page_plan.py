"""Execution of the commands and snippets of a page, as its entry in page_plans.toml plans it."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from tests.site.page_code import ROOT, program_environment
from tests.site.snippets import SHELL, Snippet, snippets

PLANS = Path(__file__).with_name("page_plans.toml")
EXECUTED = (SHELL, "python", "matlab")
"""Kinds of snippets that a reader may execute."""
ALL_OTHERS = "*"
TIMEOUT_S = 900.0
EMERGENCY_KEY = b"brass-otter-seven-lamps"
"""Emergency key of the example in docs/service.md."""
TOLERANT_SERVICE = f"""
[service]
arm = true
stall_ms = 100000.0
emergency_key_sha256 = "{sha256(EMERGENCY_KEY).hexdigest()}"
"""
SERVICE = "board"
"""Name of the service on the pages."""


@dataclass(frozen=True)
class PagePlan:
    """Entry of a page in page_plans.toml, which explains its keys."""

    setup: str = ""
    service: str = ""
    replace: Mapping[str, str] = field(default_factory=dict)
    exits: Mapping[str, list[int]] = field(default_factory=dict)
    python: str = ""
    elsewhere: Mapping[str, str] = field(default_factory=dict)
    not_run: Mapping[str, str] = field(default_factory=dict)

    def entry(self, snippet: Snippet) -> str | None:
        """Return the key of `elsewhere` or `not_run` that a snippet begins with; None for one that is executed."""
        for key in (*self.not_run, *self.elsewhere):
            if snippet.text.startswith(key):
                return key
        return ALL_OTHERS if ALL_OTHERS in self.elsewhere else None

    def adapt(self, text: str) -> str:
        """Return a text of the page with its replacements."""
        for old, new in self.replace.items():
            text = text.replace(old, new)
        return text

    def exit_codes(self, command: str) -> list[int]:
        """Return the allowed exit codes of a command of the page."""
        return next((codes for start, codes in self.exits.items() if command.startswith(start)), [0])


@cache
def plans() -> dict[str, PagePlan]:
    """Return the plan of each page, by the page's name."""
    raw: dict[str, Any] = tomllib.loads(PLANS.read_text(encoding="utf-8"))
    return {name: PagePlan(**entry) for name, entry in raw.items()}


def executable_snippets(page: Path) -> list[Snippet]:
    """Return the snippets of a page that a reader may execute: only shell commands on a page with a block `console`."""
    page_snippets = list(snippets(page))
    kinds = (SHELL,) if any(snippet.kind == "console" for snippet in page_snippets) else EXECUTED
    return [snippet for snippet in page_snippets if snippet.kind in kinds]


def executed_snippets(page: Path) -> list[Snippet]:
    """Return the snippets of a page that its plan executes."""
    plan = plans().get(page.name, PagePlan())
    return [snippet for snippet in executable_snippets(page) if plan.entry(snippet) is None]


def execute_page(page: Path, folder: Path) -> None:
    """Execute the commands of a page in its order, then its Python snippets, in `folder` beside a copy of `deploy`.

    Raises AssertionError for a command that ends with an exit code that its plan does not allow.
    """
    plan, snippets_of_page = plans().get(page.name, PagePlan()), executed_snippets(page)
    shutil.copytree(ROOT / "deploy", folder / "deploy")
    for specification in (folder / "deploy").glob("*-spec.toml"):
        shutil.copy(specification, folder)  # Copied configurations refer to these files.
    (folder / "runtime").mkdir(mode=0o700)
    environment = program_environment(folder) | {"RUNTIME_DIRECTORY": str(folder / "runtime")}
    run_command("set -e\n" + plan.setup, [0], folder, environment)
    service = _start_service(folder / plan.service, folder, environment) if plan.service else None
    try:
        current_folder = folder
        for snippet in snippets_of_page:
            if snippet.kind == SHELL and snippet.text.startswith("cd "):
                current_folder = current_folder / snippet.text.removeprefix("cd ").strip()
            elif snippet.kind == SHELL:
                run_command(plan.adapt(snippet.text), plan.exit_codes(snippet.text), current_folder, environment)
        if script := "\n".join(plan.adapt(snippet.text) for snippet in snippets_of_page if snippet.kind == "python"):
            (folder / "page.py").write_text(f"{plan.python}\n{script}\n", encoding="utf-8")
            run_command(f"{sys.executable} page.py", [0], folder, environment)
    finally:
        if service is not None:
            service.send_signal(signal.SIGTERM)
            service.wait(60)


def run_command(command: str, codes: list[int], folder: Path, environment: Mapping[str, str]) -> None:
    """Run a command by bash. Raises AssertionError, with its output, for an exit code that is not among `codes`."""
    completed = subprocess.run(
        ["bash", "-uo", "pipefail", "-c", command],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=TIMEOUT_S,
    )
    assert completed.returncode in codes, f"{command}\nended with {completed.returncode}:\n{completed.stdout}"


def _start_service(configuration: Path, folder: Path, environment: Mapping[str, str]) -> subprocess.Popen[bytes]:
    """Start a service on a copy of a configuration that tolerates a stalled host; return it once its loop is closed."""
    text = configuration.read_text(encoding="utf-8").replace("late_ticks = 10", "late_ticks = 0")
    text = text.replace("[loop]\n", "[loop]\nheartbeat_timeout_s = 100.0\n", 1)
    (folder / f"{SERVICE}.toml").write_text(text + TOLERANT_SERVICE, encoding="utf-8")
    service = subprocess.Popen(
        [sys.executable, "-m", "rtloop", "serve", f"{SERVICE}.toml"], cwd=folder, env=environment
    )
    end_s = time.monotonic() + TIMEOUT_S
    start = ["bash", "-c", "rtloop ctl arm && rtloop ctl setpoint x 0 && rtloop ctl start"]
    while subprocess.run(start, cwd=folder, env=environment, capture_output=True).returncode:
        assert service.poll() is None, "the service has ended"
        assert time.monotonic() < end_s, "the service does not answer"
    return service
