"""The message about a typo in a user law: one sentence, with the line of the file and the intended name."""

from __future__ import annotations

import re
from pathlib import Path
from typing import ClassVar

import pytest

from rtloop.laws import CoupledController
from rtloop.laws.mistakes import find_mistakes
from rtloop.laws.registry import find_law
from tests.command_line import run
from tests.drivers.installing import write_distribution
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
CLASS, COEFFICIENTS, BUILD, GIVES, OUTPUT, RETURN, UPDATE, ADDS = (
    LAW[: LAW.index(text)].count("\n") + 1
    for text in ("class Mine(", "    coefficients", "def build", 'return {"kp"', "def output", "return c.kp",
                 "def update", "        s.integral_um +=")
)  # fmt: skip
"""Numbers of lines in the text LAW."""
TYPOS = {
    "a signal": ("c.kp * told.error_um +", "c.kp * told.eror_um +", RETURN, "unknown signal; did you mean told.error_"),
    "a command that output still computes": (
        "told.error_um + s.integral_um\n",
        "told.error_um + told.command_um\n",
        RETURN,
        r"told\.command_um: has no value in the function output, only in the functions update and enter; "
        r"allowed here: told\.reference_um, told\.position_um, told\.error_um, told\.inputs$",
    ),
    "a drive that is not yet applied": (
        "told.error_um + s.integral_um\n",
        "(told.applied_um - s.integral_um)\n",
        RETURN,
        r"told\.applied_um: has no value in the function output, only in the functions update and enter",
    ),
    "a coefficient": ("c.kp * told", "c.kpp * told", RETURN, r"c\.kpp: unknown coefficient; did you mean c\.kp\?"),
    "an undeclared state": (
        "+ s.integral_um",
        "+ s.sum_um",
        RETURN,
        r"s\.sum_um: unknown state; known: s\.integral_um",
    ),
    "a module": ("return c.kp", "return np.sign(c.kp)", RETURN, "np is not defined; add `import numpy as np`"),
    "a name": ("return c.kp", "return tld.error_um + c.kp", RETURN, r"tld is not defined; did you mean told\?"),
    "an option in a tick": (
        "return c.kp",
        "return self.options.kp",
        RETURN,
        "self is not defined; output, .* `build`",
    ),
    "no return": ("return c.kp", "c.kp", OUTPUT, "output returns nothing; add a `return` with a number"),
    "a path without return": (
        "return c.kp",
        "if c.kp > 0:\n            return c.kp",
        RETURN,
        "has a path without `return`",
    ),
    "a return too many": (
        "s.integral_um +=",
        "return s.integral_um +",
        ADDS,
        "update returns a value; allowed: no value",
    ),
    "self": ("output(c, s, told)", "output(self, c, s, told)", OUTPUT, r"allowed: output\(c, s, told\), without self"),
    "a missing parameter": ("output(c, s, told)", "output(c, told)", OUTPUT, r"allowed: output\(c, s, told\)$"),
    "parameters in another order": ("update(c, s", "update(s, c", UPDATE, r"allowed: update\(c, s, told\)$"),
    "print": ("return c.kp", "print(s); return c.kp", RETURN, "print may wait, and a tick must not wait"),
    "a coefficient that is set": (
        "        s.integral_um +=",
        "        c.ki = 2.0; s.integral_um +=",
        ADDS,
        "cannot be set",
    ),
    "an option": (
        "self.options.ki_per_s",
        "self.options.ki",
        GIVES,
        r"raised AttributeError: .* attribute .ki.; did you mean \w+\?, in line",
    ),
    "the options": (
        "    options_model = MineOptions\n",
        "",
        CLASS,
        "names no options; add `options_model = MineOptions`",
    ),
    "a type": ("ki_per_s: float", "ki_per_s: flot", 5, "NameError: name 'flot' is not defined"),
    "an import": (
        "import Controller,",
        "import Controler,",
        1,
        r"'Controler' from 'rtloop.laws'; did you mean Controller\?",
    ),
    "syntax": ("def output(c, s, told):", "def output(c, s, told)", OUTPUT, "SyntaxError: expected ':'$"),
    "a function": ("def output", "def outptu", CLASS, f"no function `output`; is `outptu` in line {OUTPUT} meant"),
    "a base": ("class Mine(Controller)", "class Mine", CLASS, "is not a law; allowed base classes: Controller, "),
    "an attribute": ("coefficients =", "coeficients =", CLASS, f"`coeficients` in line {COEFFICIENTS} meant"),
    "a record": (
        'state = {"integral_um": float}',
        'state = ["a"]',
        COEFFICIENTS + 1,
        r"state: \['a'\]; allowed: a dict of names",
    ),
    "build without return": (
        'return {"kp": 0.1, "ki": ',
        '{"ki": ',
        BUILD,
        "build returns None; allowed: a dict with a value for",
    ),
    "what build gives": (
        '{"kp": 0.1',
        '{"kd": 0.1',
        BUILD,
        "build returns the unknown coefficient kd; allowed: kp, ki",
    ),
    "what build leaves out": ('"kp": 0.1, ', "", BUILD, "build returns no value for kp; the coefficients are kp, ki"),
    "a text": ('"kp": 0.1', '"kp": "much"', BUILD, "build returns kp = 'much'; allowed: numbers"),
    "NaN": ('"kp": 0.1', '"kp": float("nan")', BUILD, "build returns kp = nan; allowed: numbers other than NaN"),
    "an array": ('"kp": 0.1', '"kp": [0.1, 0.2]', BUILD, r"kp as an array of shape \(2,\); allowed: one number"),
    "a list": (
        "return c.kp * told.error_um",
        "return [c.kp]",
        RETURN,
        "output cannot be compiled: no operation add for",
    ),
    "memory": ("return c.kp", "return max([c.kp, 0.0] * 2) + c.kp", OUTPUT, "output allocates memory for a list"),
}
"""Replaced text, new text, line of the mistake, and expected message."""


@pytest.mark.parametrize("name", TYPOS)
def test_a_typo_is_one_sentence_with_its_line(name: str, tmp_path: Path) -> None:
    right, wrong, line, sentence = TYPOS[name]
    assert LAW.count(right) == 1
    (tmp_path / "mine.py").write_text(LAW.replace(right, wrong))
    config = tmp_path / "lab.toml"
    config.write_text(configuration(CONTROLLER, [], model=False))
    result = run("check", config)
    assert result.exit_code == 78
    first, *faults = result.stderr.splitlines()
    assert first == f"rtloop: {config}: 1 fault"
    assert len(faults) == 1
    assert re.search(rf"mine\.py.* line {line}\b", faults[0]), faults[0]
    assert re.search(sentence, faults[0]), faults[0]


def test_all_typos_of_a_law_are_listed_each_once(tmp_path: Path) -> None:
    law = LAW.replace("c.kp * told.error_um", "c.kpp * told.eror_um + c.kpp").replace("c.ki * told", "c.kii * told")
    (tmp_path / "mine.py").write_text(law)
    (tmp_path / "lab.toml").write_text(configuration(CONTROLLER, [], model=False))
    message = run("check", tmp_path / "lab.toml").stderr
    found = [(int(line), name) for line, name in re.findall(r"line (\d+): ([a-z.]+_?[a-z]*): unknown", message)]
    assert sorted(found) == [(RETURN, "c.kpp"), (RETURN, "told.eror_um"), (ADDS, "c.kii")]


@pytest.mark.parametrize(
    ("name", "message"), [("command_um", None), ("applied_um", "told.applied_um: has no value in the function")]
)
def test_a_coupled_output_may_use_the_commands_that_it_sets(name: str, message: str | None) -> None:
    class Pair(CoupledController):
        axes = 2
        coefficients: ClassVar = {"share": float}

        def build(self):
            return {"share": 0.1}

        def output(c, s, told):  # replaced by the text
            ...

    text = f"""class Pair(CoupledController):
    def output(c, s, told):
        told.command_um[0] = told.error_um[0]
        told.command_um[1] = told.error_um[1] - c.share * told.{name}[0]
"""
    mistakes = list(find_mistakes(text, {"Pair": Pair}))
    assert [mistake.line for mistake in mistakes] == ([4] if message else [])
    assert all(mistake.message.startswith(message) for mistake in mistakes)


def test_a_law_without_typos_is_taken(tmp_path: Path) -> None:
    """The law uses names of its module, of a loop and of builtin functions."""
    body = "        gain = GAIN\n        for i in range(2):\n            gain += abs(i)\n        return gain * c.kp"
    law = LAW.replace("        return c.kp", body)
    (tmp_path / "mine.py").write_text(law.replace("\n\nclass MineO", "\nGAIN = 0.0\n\n\nclass MineO", 1))
    config = tmp_path / "lab.toml"
    config.write_text(configuration(CONTROLLER, [], model=True))
    assert run("check", config).exit_code == 0


@pytest.mark.parametrize(
    ("term", "error"),
    [("1.0 / float(told.reference_um)", "ZeroDivisionError: float division by zero"),
     ("1.0 / told.reference_um", "FloatingPointError: divide by zero")],
)  # fmt: skip
def test_a_law_that_divides_by_zero_at_rest_is_named_with_its_line(term: str, error: str, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(LAW.replace("return c.kp * told.error_um", f"return {term}"))
    config = tmp_path / "lab.toml"
    config.write_text(configuration(CONTROLLER, [], model=True))
    result = run("check", config)
    assert result.exit_code == 0
    assert re.search(rf"fails at rest: \S*mine\.py, line {RETURN}: {error}", result.stderr), result.stderr


@pytest.mark.parametrize(
    ("text", "reason"),
    [("import acme_absent\n", "No module named 'acme_absent'"), ("1 / 0\n", "division by zero"),
     ("print(\n", r"'\(' was never closed")],
)  # fmt: skip
def test_an_installed_law_whose_module_cannot_be_imported_says_why(tmp_path, monkeypatch, text, reason):
    module = f"acme_law_{len(text)}"
    (tmp_path / f"{module}.py").write_text(text)
    write_distribution(tmp_path, "acme-law", "1.0", f"[rtloop.laws]\nacme = {module}:Acme\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=f"^law 'acme': {module}:Acme cannot be imported: {reason}"):
        find_law("acme")
