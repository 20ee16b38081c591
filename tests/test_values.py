"""Values that are written as JSON are finite or null."""

from __future__ import annotations

import json
import math

import numpy as np

from rtloop.values import to_jsonable


def test_numbers_that_are_not_finite_are_null_also_in_complex_numbers():
    values = {"root": complex(math.nan, 1.5), "gain": math.inf, "poles": np.array([2j, complex(3, -math.inf)])}
    text = json.dumps(to_jsonable(values), allow_nan=False)
    assert json.loads(text) == {"root": [None, 1.5], "gain": None, "poles": [[0.0, 2.0], [3.0, None]]}
