"""Snippets on a page of the documentation: paragraphs of code in its fenced and indented blocks, and their kinds."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

OPENING = re.compile(r"^```([a-z]*)")
TOML = re.compile(r"^\[+[\w.\"-]+\]+ *(#.*)?$")
PYTHON = re.compile(r"^(import|from|class|with|def) \w|^# \w+\.py$")
COMMAND = re.compile(
    r"(\$ )?(\.venv/bin/\w+|caget|camonitor|cd|curl|cyclictest|dask|echo|eval|export|make|mcap|pip|printf|python3"
    r"|rtloop|source|ssh|ssh-keygen|sudo|systemctl) "
)
"""Pattern of the beginning of a command: its first word."""
PROMPT = "$ "
SHELL, OTHER = "shell", "text"


@dataclass(frozen=True)
class Snippet:
    """Paragraph of a block: its kind ("shell", "toml", "python", "text", or the block's language) and its text."""

    kind: str
    text: str

    @property
    def label(self) -> str:
        """First line, by which a plan names the snippet."""
        return self.text.partition("\n")[0]


def snippets(page: Path) -> Iterator[Snippet]:
    """Yield the snippets of a page in order; each command is a separate snippet, without its prompt."""
    for language, block in _blocks(page.read_text(encoding="utf-8").splitlines()):
        for snippet in _paragraphs(SHELL if language == "sh" else language, block):
            if snippet.kind == SHELL:
                yield from (Snippet(SHELL, command) for command in _commands(snippet.text))
            else:
                yield snippet


def _blocks(lines: list[str]) -> Iterator[tuple[str, str]]:
    """Yield (language, text) of each fenced block, and ("", text) of each indented one that follows an empty line."""
    number = 0
    while number < len(lines):
        if fence := OPENING.match(lines[number]):
            end = lines.index("```", number + 1)
            yield fence[1], "\n".join(lines[number + 1 : end])
            number = end + 1
            continue
        end = number
        if lines[number].startswith("    ") and (number == 0 or not lines[number - 1].strip()):
            while end < len(lines) and (lines[end].startswith("    ") or not lines[end].strip()):
                end += 1
            text = textwrap.dedent("\n".join(lines[number:end])).strip("\n")
            if not text.startswith("- "):  # Otherwise the block belongs to a list.
                yield "", text
        number = max(end, number + 1)


def _paragraphs(kind: str, block: str) -> Iterator[Snippet]:
    """Yield the parts of an indented block (`kind` is ""), one kind each; a fenced block is one part of kind `kind`."""
    if kind:
        yield Snippet(kind, block)
        return
    parts: list[list[str]] = []
    kinds: list[str] = []
    for paragraph in re.split(r"\n\n+", block):
        part_kind = _kind(paragraph)
        if kinds and part_kind in (kinds[-1], OTHER) and kinds[-1] != SHELL:
            parts[-1].append(paragraph)
        else:
            kinds.append(part_kind)
            parts.append([paragraph])
    for part_kind, paragraphs in zip(kinds, parts, strict=True):
        yield Snippet(part_kind, "\n\n".join(paragraphs))


def _kind(paragraph: str) -> str:
    """Return the kind of a paragraph of an indented block by its first line."""
    first = paragraph.partition("\n")[0]
    if COMMAND.match(first):
        return SHELL
    return "toml" if TOML.match(first) else "python" if PYTHON.match(first) else OTHER


def _commands(text: str) -> Iterator[str]:
    """Yield the commands of a snippet without their prompts; a line that ends with "\\" continues."""
    lines = iter(text.splitlines())
    for line in lines:
        command = line.removeprefix(PROMPT)
        while command.endswith("\\"):
            command += "\n" + next(lines)
        yield command
