"""Execute the code on every page of the documentation: `make soak NAME=pages`."""

from __future__ import annotations

import sys

import pytest

if __name__ == "__main__":
    sys.exit(pytest.main(["tests/site/test_pages.py", "-m", "soak or not soak", *sys.argv[1:]]))
