"""Units as files write them, and the exact factor from one to another.

A unit is a product of powers: `V`, `mV`, `µm/V`, `V·µm/V`, `1/s`, `m/s²`. Its scale is a fraction, so that a conversion
by a power of ten rounds once.
"""

from __future__ import annotations

import re
from fractions import Fraction
from typing import NamedTuple

from rtloop.foundation.arrays import Real

PREFIXES = {
    "": 0, "f": -15, "p": -12, "n": -9, "µ": -6, "u": -6, "m": -3, "c": -2, "d": -1, "k": 3, "M": 6, "G": 9,
}  # fmt: skip
"""Exponents of ten by prefix."""
BASES = {"m": "m", "V": "V", "s": "s", "A": "A", "N": "N", "g": "g", "K": "K", "Pa": "Pa", "Ohm": "Ohm", "Hz": "1/s"}
"""Symbols that take a prefix, with their base unit."""
UNIT_NAMES = {
    "volt": "V", "volts": "V", "millivolt": "mV", "millivolts": "mV", "meter": "m", "meters": "m", "metre": "m",
    "metres": "m", "micrometer": "µm", "micrometers": "µm", "micrometre": "µm", "micron": "µm", "microns": "µm",
    "nanometer": "nm", "nanometers": "nm", "sec": "s", "secs": "s", "second": "s", "seconds": "s", "sek": "s",
    "sekunden": "s", "msec": "ms", "usec": "µs", "millisecond": "ms", "milliseconds": "ms", "microseconds": "µs",
    "microsecond": "µs", "nanosecond": "ns", "nanoseconds": "ns", "minute": "min", "minutes": "min", "mins": "min",
    "hour": "h", "hours": "h", "hrs": "h", "day": "d", "days": "d", "microvolt": "µV", "microvolts": "µV",
    "kilovolt": "kV", "kilovolts": "kV", "millimeter": "mm", "millimeters": "mm", "millimetre": "mm",
    "hertz": "Hz", "hr": "h", "ampere": "A", "amp": "A", "amps": "A", "amperes": "A", "celsius": "°C", "percent": "%",
    "vdc": "V", "vac": "V", "mvdc": "mV", "newton": "N", "angstrom": "Å", "count": "counts",
}  # fmt: skip
UNPREFIXED_UNITS = {
    "Å": (Fraction(1, 10**10), "m"), "min": (Fraction(60), "s"), "h": (Fraction(3600), "s"),
    "d": (Fraction(86400), "s"),
    "%": (Fraction(1, 100), ""),
    "1": (Fraction(1), ""), "-": (Fraction(1), ""), "": (Fraction(1), ""), "°C": (Fraction(1), "degC"),
    "degC": (Fraction(1), "degC"), "rad": (Fraction(1), "rad"), "deg": (Fraction(1), "deg"), "°": (Fraction(1), "deg"),
    "counts": (Fraction(1), "counts"), "LSB": (Fraction(1), "counts"),
}  # fmt: skip
_POWER = re.compile(r"(.*?[^\d^])\^?([-+]?\d)?$")
_SUPERSCRIPT = str.maketrans("⁻⁰¹²³⁴", "-01234")
_SYMBOL_VARIANTS = str.maketrans({"μ": "µ", "Ω": "Ohm", "⋅": "·", "*": "·"})


class UnknownUnit(ValueError):
    """The unit is not known, or two units differ in kind."""


Powers = tuple[tuple[str, int], ...]
"""Symbols without a prefix, sorted, and their exponents."""


class Unit(NamedTuple):
    """`scale` times the product of the `powers`."""

    scale: Fraction
    powers: Powers


def parse_unit(text: str) -> Unit:
    """Return a unit's scale and powers, of a text such as "µm/V"; "" is the number 1.

    Raises UnknownUnit for an unknown symbol.
    """
    scale, powers = Fraction(1), Powers()
    for place, part in enumerate(text.strip().translate(_SYMBOL_VARIANTS).split("/")):
        sign = 1 if place == 0 else -1
        for factor in part.strip().split("·"):
            base_scale, base_powers = _parse_factor(factor.strip(), text)
            scale *= base_scale**sign
            powers = _multiply_powers(powers, tuple((symbol, sign * exponent) for symbol, exponent in base_powers))
    return Unit(scale, powers)


def factor_between(source: str, target: str, by: str = "") -> Fraction:
    """Return the factor from values in `source` to values in `target`.

    `by` is the unit of a sensitivity or gain that multiplies the values, such as µm/V from V to µm; "" without one.
    Raises UnknownUnit for an unknown unit, or if the two sides differ in kind.
    """
    source_unit, by_unit, target_unit = parse_unit(source), parse_unit(by), parse_unit(target)
    if _multiply_powers(source_unit.powers, by_unit.powers) != target_unit.powers:
        source_text = f"{source or '1'} · {by}" if by else source or "a number without a unit"
        raise UnknownUnit(f"{source_text} cannot be converted to {target or 'a number without a unit'}")
    return source_unit.scale * by_unit.scale / target_unit.scale


def is_unit(text: str) -> bool:
    """Whether a text is a known unit; a number alone is none, nor is ""."""
    try:
        parse_unit(text)
    except UnknownUnit:
        return False
    return bool(re.search(r"[^\W\d_]|[%°]", text))


def scale_values(values: Real, factor: Fraction) -> Real:
    """Return the values times the factor, rounded once if the factor is a whole number or its reciprocal.

    A factor of 1 returns the same array.
    """
    if factor == 1:
        return values
    if abs(factor) < 1 and abs(factor.numerator) == 1:
        return values / float(1 / factor)
    return values * float(factor)


def _multiply_powers(first_powers: Powers, second_powers: Powers) -> Powers:
    """Return the powers of the product of two units: exponents added, zeros left out, sorted by symbol."""
    exponents = dict(first_powers)
    for symbol, exponent in second_powers:
        exponents[symbol] = exponents.get(symbol, 0) + exponent
    return tuple(sorted((symbol, exponent) for symbol, exponent in exponents.items() if exponent))


def _parse_factor(text: str, unit_text: str) -> Unit:
    """Return one factor of a unit, with its exponent. Raises UnknownUnit for an unknown symbol, naming `unit_text`."""
    if text in UNPREFIXED_UNITS:
        scale, symbol = UNPREFIXED_UNITS[text]
        return Unit(scale, ((symbol, 1),) if symbol else ())
    match = _POWER.fullmatch(text.translate(_SUPERSCRIPT))
    name, exponent = (match[1], int(match[2] or 1)) if match else (text, 1)
    name = UNIT_NAMES.get(name, UNIT_NAMES.get(name.lower(), name))
    if name in UNPREFIXED_UNITS and name:
        scale, symbol = UNPREFIXED_UNITS[name]
        return Unit(scale**exponent, ((symbol, exponent),))
    for base, meaning in BASES.items():
        prefix = name.removesuffix(base)
        if name.endswith(base) and prefix in PREFIXES:
            symbol, sign = ("s", -1) if meaning == "1/s" else (meaning, 1)
            return Unit((Fraction(10) ** PREFIXES[prefix]) ** exponent, ((symbol, sign * exponent),))
    raise UnknownUnit(f"unit {unit_text!r} is not known; allowed: V, mV, µm, nm, m, s, ms, Hz, µm/V and similar ones")
