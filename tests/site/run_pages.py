"""Execute the code on every page of the documentation: `make soak NAME=pages`; FLAGS="-k service" for one page."""

from __future__ import annotations

import sys

import pytest

FILES = ["tests/site/test_pages.py", "tests/site/test_page_commands.py"]

if __name__ == "__main__":
    sys.exit(pytest.main([*FILES, "-m", "soak or not soak", *sys.argv[1:]]))
