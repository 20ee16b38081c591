"""Bouc-Wen and Preisach actuators, which no sum of plays is: the error that is reported beside the true one.
`make soak-truths`.

Several independent sets of recordings, each with random pasts, turning points and noise. The true error is that of the
model as it is written, its plays stepped here, on drives that come later. Beside it: the error that is held out, over
the same on as many later recordings, where offset and memory are estimated again.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from rtloop.design.identification.hysteresis.identify_from_parts import identify_from_parts
from rtloop.design.identification.hysteresis.judgement import combine_errors
from tests.design.other_truths import bouc_wen, preisach
from tests.design.test_error_as_written import recorded, true_um

TRUE_DRIVES, ALLOWED, SURELY = 32, 0.2, 2.5
"""Drives of the true error; what the reported one may be off by, and by how many of its standard errors at most where
one set is off by more."""


def main() -> None:
    """A row for each set; 1 where the median of an actuator's sets, or a set beyond its standard error, is off."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=6)
    parser.add_argument("--recordings", type=int, default=6)
    given = parser.parse_args()
    print("actuator  set  as written µm      true µm  ratio  held out µm       later µm  ratio  taken")
    good = True
    for truth in (bouc_wen, preisach):
        ratios = []
        for number in range(given.sets):
            first = 10_000 * number
            runs = [recorded(truth, first + i) for i in range(given.recordings)]
            others = [recorded(truth, first + 1000 + i) for i in range(given.recordings)]
            found = identify_from_parts(runs, 8, "chebyshev-from-0", other_runs=others)
            true = true_um(truth, found.hysteresis.model, range(first + 2000, first + 2000 + TRUE_DRIVES))
            written = combine_errors([one.rms_of_plays_um for one in found.judgements])
            error, later = (
                combine_errors([one.rms_um for one in group]) for group in (found.judgements, found.other_judgements)
            )
            print(
                f"{truth.__name__:9}{number:4}{written.rms_um:9.3f} ± {written.std_um:.3f}{true:11.3f}"
                f"{written.rms_um / true:7.2f}{error.rms_um:9.3f} ± {error.std_um:.3f}{later.rms_um:10.3f}"
                f"{error.rms_um / later.rms_um:7.2f}  {' + '.join(('plays', *found.terms))}",
                flush=True,
            )
            ratios.append(written.rms_um / true)
            off = abs(ratios[-1] - 1)
            good &= off <= ALLOWED or off * true <= SURELY * (written.std_um or 0.0)
        above = sum(abs(ratio - 1) > ALLOWED for ratio in ratios)
        print(f"{truth.__name__}: median ratio {np.median(ratios):.2f}, {above} of {given.sets} off by more than 20 %")
        good &= abs(np.median(ratios) - 1) <= ALLOWED
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
