"""A Preisach actuator: the error reported as held out beside that on later recordings. `make soak-preisach`."""

from __future__ import annotations

import sys

import numpy as np

from rtloop.design.identification.hysteresis.identify_from_parts import identify_from_parts
from tests.design.other_truths import preisach
from tests.design.test_identify_from_parts import recorded

RECORDINGS, ALLOWED = 8, 0.2


def main() -> None:
    """1 where the two are apart by more than is allowed."""
    runs, fresh = ([recorded(preisach, first + i)[0] for i in range(RECORDINGS)] for first in (0, 100))
    found = identify_from_parts(runs, 8, "chebyshev-from-0", others=fresh)
    reported, true = (
        float(np.sqrt(np.mean([one.rms_um**2 for one in group]))) for group in (found.judgements, found.others)
    )
    print(f"held out {reported:.3f} µm rms, later {true:.3f} µm; taken: {' + '.join(('plays', *found.terms))}")
    sys.exit(1 if abs(reported / true - 1) > ALLOWED else 0)


if __name__ == "__main__":
    main()
