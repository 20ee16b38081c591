"""All variants of the MCAP conformance suite through `info` and `import`: each opened, or refused with a reason.

    python -m tests.soak.conformance [MOST]

MOST: only those with up to so many features, or without up to so many of all.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from tests.interchange.conformance import FEATURES, variants
from tests.interchange.test_conformance import check


def main() -> int:
    """Print how many variants were tried, and what was wrong with any."""
    wrong, tried, most = [], 0, int(sys.argv[1]) if len(sys.argv) > 1 else len(FEATURES)
    with tempfile.TemporaryDirectory() as folder:
        for variant in variants(most):
            tried += 1
            try:
                check(variant, Path(folder))
            except AssertionError as error:
                wrong.append(f"{variant}: {error}")
    print(f"{tried} variants, {len(wrong)} wrong")
    print("\n".join(wrong))
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
