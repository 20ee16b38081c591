"""All variants of the MCAP conformance suite through `info` and `import`: each opened, or refused with a reason.

    python -m tests.soak.conformance [MOST]

MOST: only variants with at most MOST features, or with all features but at most MOST.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from tests.interchange.conformance import FEATURES, variants
from tests.interchange.test_conformance import check


def main() -> int:
    """Print the number of variants and the fault of each wrong one; return 1 if there is a fault."""
    faults, count, max_features = [], 0, int(sys.argv[1]) if len(sys.argv) > 1 else len(FEATURES)
    with tempfile.TemporaryDirectory() as folder:
        for variant in variants(max_features):
            count += 1
            try:
                check(variant, Path(folder))
            except AssertionError as error:
                faults.append(f"{variant}: {error}")
    print(f"{count} variants, {len(faults)} wrong")
    print("\n".join(faults))
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
