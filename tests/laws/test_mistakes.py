"""What is said of a typo in a law of one's own: one sentence, with the line of the law's file and the name meant."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.asked import run
from tests.laws.changing import configuration

LAW = """from rtloop.laws import Controller, ControllerOptions


class MineOptions(ControllerOptions):
    ki_per_s: float


class Mine(Controller):
    options_model = MineOptions
    coefficients = {"kp": float, "ki": float}
    state = {"integral_um": float}

    def build(self):
        return {"kp": 0.1, "ki": self.options.ki_per_s * self.period_s}

    def output(c, s, told):
        return c.kp * told.error_um + s.integral_um

    def update(c, s, told):
        s.integral_um += c.ki * told.error_um + told.applied_um - told.command_um
"""
CONTROLLER = '[axis.controller]\nfile = "mine.py"\nki_per_s = 150.0\n'
BUILD, GIVES, OUTPUT, RETURN = (LAW[: LAW.index(text)].count("\n") + 1 for text in
                                ("def build", 'return {"kp"', "def output", "return c.kp"))  # fmt: skip
TYPOS = {
    "a signal": ("c.kp * told.error_um +", "c.kp * told.eror_um +", RETURN, "told.eror_um: .*; error_um is meant"),
    "a coefficient": ("c.kp * told", "c.kpp * told", RETURN, "c.kpp: not among its coefficients; kp is meant"),
    "an undeclared state": ("+ s.integral_um", "+ s.sum_um", RETURN, "s.sum_um: not among its state; .* integral_um"),
    "a module": ("return c.kp", "return np.sign(c.kp)", RETURN, "np: nothing has this name; `import numpy as np`"),
    "a name": ("return c.kp", "return tld.error_um + c.kp", RETURN, "tld: nothing has this name; told is meant"),
    "no return": ("return c.kp", "c.kp", OUTPUT, "output returns nothing: a `return` is missing"),
    "self": (
        "output(c, s, told)",
        "output(self, c, s, told)",
        OUTPUT,
        r"output\(c, s, told\) is needed, without `self`",
    ),
    "a missing parameter": ("output(c, s, told)", "output(c, told)", OUTPUT, r"output\(c, s, told\) is needed$"),
    "print": ("return c.kp", "print(s); return c.kp", RETURN, "print: it may wait, and a tick cannot"),
    "an option": ("self.options.ki_per_s", "self.options.ki", GIVES, "raised AttributeError: .* no attribute 'ki'"),
    "what build gives": ('{"kp": 0.1', '{"kd": 0.1', BUILD, "it gives kd; the coefficients are kp, ki"),
    "what build leaves out": ('"kp": 0.1, ', "", BUILD, "it gives no kp; the coefficients are kp, ki"),
    "a text": ('"kp": 0.1', '"kp": "much"', BUILD, "it gives kp = 'much', which is no number"),
    "a list": ("return c.kp * told.error_um", "return [c.kp]", RETURN, "output cannot be compiled: No implementation"),
}
"""What is replaced, by what, the line where, and what is said."""


@pytest.mark.parametrize("name", TYPOS)
def test_a_typo_is_one_sentence_with_its_line(name: str, tmp_path: Path) -> None:
    right, wrong, line, said = TYPOS[name]
    assert LAW.count(right) == 1
    (tmp_path / "mine.py").write_text(LAW.replace(right, wrong))
    config = tmp_path / "lab.toml"
    config.write_text(configuration(CONTROLLER, [], model=True))
    result = run("check", config)
    assert result.exit_code == 78
    first, *faults = result.stderr.splitlines()
    assert first == f"rtloop: {config}: 1 fault"
    assert len(faults) == 1
    assert re.search(rf"mine\.py.* line {line}\b", faults[0]), faults[0]
    assert re.search(said, faults[0]), faults[0]


def test_a_law_without_typos_is_taken(tmp_path: Path) -> None:
    """With names from its module, from a loop and from a function within."""
    body = "        gain = GAIN\n        for i in range(2):\n            gain += abs(i)\n        return gain * c.kp"
    law = LAW.replace("        return c.kp", body)
    (tmp_path / "mine.py").write_text(law.replace("\n\nclass MineO", "\nGAIN = 0.0\n\n\nclass MineO", 1))
    config = tmp_path / "lab.toml"
    config.write_text(configuration(CONTROLLER, [], model=True))
    assert run("check", config).exit_code == 0
