"""Types of arrays in signatures: `Real` (float64) and `Complex` (complex128)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Complex = npt.NDArray[np.complex128]
Real = npt.NDArray[np.float64]
