"""Run the tests of tests/campaigns that are too long for `make test`: accidents of campaigns and archives."""

from __future__ import annotations

import sys

import pytest

if __name__ == "__main__":
    sys.exit(pytest.main(["-m", "soak", "tests/campaigns", *sys.argv[1:]]))
