"""Page of the example configurations that ship in `deploy/`, with their text."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
DEPLOY = ROOT / "deploy"


def example_files() -> list[Path]:
    """Return the example files, configurations of the paper first."""
    files = [*DEPLOY.glob("*.toml"), *DEPLOY.glob("laws/*.toml")]
    return sorted(files, key=lambda path: (path.parent != DEPLOY, path.name != "paper.toml", path.name))


def anchor(path: Path) -> str:
    """Return the anchor of an example, such as "laws-pid"."""
    return str(path.relative_to(DEPLOY).with_suffix("")).replace("/", "-")


def example_page() -> str:
    """Return the page of all examples."""
    parts = [
        "---\nsearch:\n  exclude: true\n---\n\n# Examples\n\nThese files lie in the folder `deploy/` of the source. "
        "`rtloop init` writes files of your own: [First steps](../first-steps.md).\n"
    ]
    for path in example_files():
        text = path.read_text(encoding="utf-8").rstrip()
        parts.append(f"## {path.relative_to(ROOT)} {{ #{anchor(path)} }}\n\n```toml\n{text}\n```\n")
    return "\n".join(parts)
