"""Texts of user laws that fail while they run, or are refused before; tests write them beside a configuration."""

from __future__ import annotations

HEAD = """
from rtloop.laws import Controller, ControllerOptions
from rtloop.kernel.validity import Allowed

class Mine(Controller):
    coefficients = {"ki": float, "limits": (float, 4)}
    state = {"integral_um": float, "seen": float, "past_um": (float, 4)}

    def build(self):
        return {"ki": 100.0 * self.period_s, "limits": [1.0, 2.0, 3.0, 4.0]}

    def enter(c, s, told):
        s.integral_um = told.command_um
"""
OUTPUT = "    def output(c, s, told):\n{}        return s.integral_um\n"
UPDATE = (
    "    def update(c, s, told):\n{}        s.seen += 1.0\n"
    "        s.integral_um += c.ki * told.error_um + told.applied_um - told.command_um\n"
)
AT_TICK_200 = "        if s.seen == 200.0:\n            {}\n"
"""A statement that runs at tick 200."""


def text(output: str = "", update: str = "") -> str:
    """Return the text of a law whose functions run the statements `output` and `update` at tick 200."""
    bodies = (AT_TICK_200.format(body) if body else "" for body in (output, update))
    return HEAD + "".join(part.format(body) for part, body in zip((OUTPUT, UPDATE), bodies, strict=True))


ENDLESS_UM = 30.0
FOR_EVER = (
    "        if told.reference_um > {} and s.seen > 999:\n            while True:\n                s.seen += 1.0\n"
)
ENDLESS = HEAD + OUTPUT.format(FOR_EVER.format(ENDLESS_UM)) + UPDATE.format("")
"""Text of a law whose output never returns once the reference is above ENDLESS_UM, after a tenth of a second."""
FAILING = {
    "divides by zero": (text("return 1.0 / (s.seen - 200.0)"), 200, "raised an exception in output of the controller"),
    "divides a whole number by zero": (
        text("return 1.0 * (7 // (int(s.seen) - 200))"),
        200,
        "raised an exception in output",
    ),
    "returns NaN": (text("return 1e308 * 1e308 * 0.0"), 200, "returned nan from output"),
    "returns infinity": (text("return 1e308 * 1e308"), 200, "returned inf from output of the controller"),
    "returns too much": (text("return -2e9"), 200, "returned -2e+09 from output of the controller"),
    "grows without bound": (text("", "s.integral_um = 1e12"), 201, "returned 1e+12 from output of the controller"),
    "reads beyond its array": (
        text("return c.limits[int(s.seen)]"),
        200,
        "raised an exception in output of the controller",
    ),
    "writes beyond its array": (
        text("", "s.past_um[int(s.seen)] = 1.0"),
        201,
        "raised an exception in update of the controller",
    ),
    "writes before its array": (
        text("", "s.past_um[-int(s.seen)] = 1.0"),
        201,
        "raised an exception in update of the controller",
    ),
    "raises": (text("raise ValueError('too late')"), 200, "raised an exception in output of the controller"),
}
"""Text of the law, tick of the trip, part of the trip's reason."""
CLASS = "class Mine(Controller):\n"
USLEEP = "from numba import types\nusleep = types.ExternalFunction('usleep', types.int32(types.uint32))\n"
BY_ADDRESS = "import ctypes\nusleep = ctypes.CDLL(None).usleep\nusleep.argtypes = [ctypes.c_uint]\n"
REFUSED = {
    "prints": ("say = print\n" + text("say(s.seen)"), "needs Python's interpreter"),
    "takes memory": ("import numpy as np\n" + text("return np.zeros(3)[0]"), "allocates memory"),
    "calls libm": ("import math\n" + text("return math.sin(told.error_um)"), "differs between processors"),
    "calls what is no intrinsic": (
        "import math\n" + text("return math.erf(told.error_um)"),
        "erf, which differs between",
    ),
    "sleeps": ("import time\n" + text("time.sleep(1.0)"), "cannot be compiled"),
    "sleeps by the C library": (USLEEP + text("usleep(1000)"), "usleep, which is outside the law and may wait"),
    "sleeps with libm": (USLEEP + text("usleep(1000)").replace(CLASS, f"{CLASS}    libm = True\n"), "calls usleep"),
    "sleeps by an address": (
        BY_ADDRESS + text("usleep(1000)"),
        "calls a function by its address, which is outside the law",
    ),
    "opens a file": ("opened = open\n" + text("opened('x')"), "cannot be compiled"),
    "names what is not there": (text("return s.nothing"), "s.nothing: unknown state"),
    "is no Python": ("def f(:\n", "line 1: SyntaxError"),
    "defines no law": ("x = 1\n", "defines no law"),
    "raises when it is read": ("1 / 0\n", "ZeroDivisionError"),
}
"""Text of the law, part of the message that refuses it."""
