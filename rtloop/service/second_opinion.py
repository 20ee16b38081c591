"""Second opinion on the loop by python-control, before the service may first be armed.

It is computed in a separate process once the loop runs: python-control takes more than a second to import. An
agreement is stored in the cache folder, and the next start of the same loop uses it.
"""

from __future__ import annotations

import hashlib
import logging
from importlib.metadata import version
from pathlib import Path

import numpy as np

from rtloop.configuration.prepare import Prepared
from rtloop.drivers.errors import DriverError
from rtloop.errors import RtloopError, UnavailableError
from rtloop.foundation import timing
from rtloop.foundation.native.cache import CACHE_FOLDER
from rtloop.foundation.native.cache_files import read, write
from rtloop.laws.limited.process import LimitedProcess
from rtloop.service.desk import Refusal

TIMEOUT_S = 60.0
"""Longest wait of `require`; a busy host may take many seconds to import python-control."""
PACKAGE = Path(__file__).parents[1]
MATHEMATICS = ("analysis", "configuration", "linear", "values.py")
"""Rooms and files that compute the loop and are not in the digest of the cache folder."""
log = logging.getLogger("rtloop")

UNCOMPARED = {"reference", "limits", "interlocks", "margins"}
"""Options of an axis that change neither poles nor margins nor the step of its linear loop."""


class SecondOpinion:
    """Second opinion on the loops of a service.

    `faults` are the disagreements, a sentence each; [] for an agreement, and before `compute` has ended.
    """

    def __init__(self) -> None:
        """Begin without a comparison: `require` waits until `compute` has ended."""
        self.faults: list[str] = []
        self._is_known = timing.event()

    def compute(self, prepared: Prepared) -> None:
        """Compare the loops of all axes with python-control's, unless an agreement on the same loops is stored.

        Sets `faults`, and stores an agreement in the cache folder. A comparison that cannot be made is logged, and
        counts as an agreement, which is not stored. Lets `require` return in any case.
        """
        try:
            path = CACHE_FOLDER / f"loops-{_digest(prepared)}.agreed"
            if read(path) is None:
                self.faults = _compare(prepared)
                if not self.faults:
                    write(path, b"")
        except (RtloopError, DriverError, OSError) as error:
            log.warning("python-control could not check rtloop's computation of the loop: %s", error)
        finally:
            self._is_known.set()

    def require(self, activity: str) -> None:
        """Wait for the end of `compute`. Raises Refusal, which names `activity`, with all disagreements, if any.

        Raises UnavailableError if `compute` has not ended after TIMEOUT_S.
        """
        if not self._is_known.wait(TIMEOUT_S):
            raise UnavailableError(
                f"{activity}: the check of the loop by python-control has not ended after {TIMEOUT_S:g} s; try again"
            )
        if self.faults:
            raise Refusal(
                f"{activity}: refused, because rtloop and python-control compute different figures of this loop; "
                f"report it as a fault of rtloop: {'; '.join(self.faults)}"
            )


def _compare(prepared: Prepared) -> list[str]:
    """Return `_faults` of `prepared`, computed in a separate process that ends with this call; [] for an agreement.

    Raises RtloopError or DriverError if the process ends, takes too long or cannot compare.
    """
    process = LimitedProcess()
    try:
        return process.run(_faults, prepared, compiles=any(law.text for law in prepared.configuration.laws))
    finally:
        process.end()


def _faults(prepared: Prepared) -> list[str]:
    """Return the disagreements between rtloop's and python-control's figures of the loops of `prepared`, a sentence
    each; [] for an agreement.
    """
    from rtloop.configuration.second_opinion import faults_on_models

    return faults_on_models(prepared)


def _digest(prepared: Prepared) -> str:
    """Return a digest (24 hexadecimal digits) of the loops and of the code that computes them.

    It covers the controllers, laws, delays and rate, the options of the axes except UNCOMPARED, which do not affect the
    compared quantities, the source text of MATHEMATICS, and the version of python-control.
    """
    controllers = np.ascontiguousarray(np.asarray(prepared.plan.coefficients)["controller"])
    digest = hashlib.sha256(controllers.tobytes() + repr(prepared.configuration.laws).encode())
    for axis, check in zip(prepared.configuration.axes, prepared.checks, strict=True):
        options = axis.model_dump(exclude=UNCOMPARED)
        digest.update(f"{options!r} {check.delay_ticks} {prepared.plan.pacing.rate_hz}".encode())
    for place in MATHEMATICS:
        source = PACKAGE / place
        for path in sorted(source.rglob("*.py")) if source.is_dir() else [source]:
            digest.update(path.read_bytes())
    digest.update(version("control").encode())
    return digest.hexdigest()[:24]
