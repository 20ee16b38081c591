"""Configuration sections with the designed controller and taps, and comments on their origin."""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Mapping

from rtloop.design.robust.certificate import Certificate
from rtloop.design.robust.programme import Taps
from rtloop.design.robust.search import RobustDesign
from rtloop.design.robust.shape import Subject, TapDesign
from rtloop.design.synthesis.section import commented_section, configuration_around, controller_values, formula
from rtloop.design.synthesis.specification import DesignOptions, OutputOptions
from rtloop.design.toml_text import edit_text, write_section
from rtloop.version import __version__


def robust_section(robust: RobustDesign, design: DesignOptions, source: str, text: str) -> str:
    """Return [axis.controller] as TOML below comments on its origin, to insert below an [[axis]].

    `source` is the specification's name, `text` its content.
    """
    return commented_section(robust.controller, _output(design), provenance(robust, design, source, text))


def robust_configuration(
    robust: RobustDesign, design: DesignOptions, source: str, text: str, axis: str, specification: str
) -> str:
    """Return TOML: the controller on axis `axis`, and a simulated rig of the plant of `design`.

    `source` is the specification's name, `text` its content, for its SHA-256 in a comment, `specification` its path
    relative to the configuration.
    """
    written_design = design.model_copy(update={"controller": _output(design)})
    lines = provenance(robust, design, source, text)
    return configuration_around(robust.controller, written_design, lines, axis, specification)


def insert_controller(
    text: str, robust: RobustDesign, design: DesignOptions, source: str, spec_text: str, axis: str
) -> str:
    """Return a configuration's `text` with the controller in axis `axis` and new comments on its origin.

    `source` and `spec_text` are the specification's name and content. Raises ValueError for an unknown axis.
    """
    return _replace_in_axis(
        text, axis, {"controller": robust_values(robust, design)},
        provenance(robust, design, source, spec_text),
    )  # fmt: skip


def insert_taps(
    text: str, tap_design: TapDesign, subject: Subject, source: str, axis: str, specification: str | None
) -> str:
    """Return a configuration's `text` with both rows of taps in axis `axis`, and `specification` as its specification
    file.

    None leaves the specification unchanged. Raises ValueError for an unknown axis.
    """
    values = taps_values(tap_design.taps)
    reference = {} if specification is None else {"specification": specification}
    return _replace_in_axis(
        text, axis, {"prefilter": values, **reference}, taps_provenance(tap_design, subject, source)
    )


def taps_section(tap_design: TapDesign, subject: Subject, source: str) -> str:
    """Return [axis.prefilter] as TOML below comments on its origin; `source` is the name of the configuration with the
    controller.
    """
    return write_section("axis.prefilter", taps_values(tap_design.taps), taps_provenance(tap_design, subject, source))


def taps_values(taps: Taps) -> dict[str, list[float]]:
    """Return [axis.prefilter] as plain values: `taps` and `command_taps`."""
    return {"taps": taps.reference.tolist(), "command_taps": taps.command.tolist()}


def taps_provenance(tap_design: TapDesign, subject: Subject, source: str) -> list[str]:
    """Return comment lines, without #, on the origin of taps and their proved figures; `source` is the name of the
    configuration with their controller, or of the specification for both.
    """
    options, proof = subject.options.scenarios, tap_design.proof
    return [
        f"Taps by rtloop {__version__} (`rtloop design shape`) for the controller of {source}, resonances within "
        f"±{options.resonance_percent:g} % and gains within ±{options.gain_percent:g} % of the model's",
        f"on {tap_design.proved_count} plants: settling time ≤ {proof.settling_ms:.4g} ms, overshoot ≤ "
        f"{100 * proof.overshoot:.3g} %, command v {proof.lowest_command:.4g} … {proof.highest_command:.4g} per unit "
        "step",
    ]


def certified_values(proof: Certificate) -> list[tuple[str, float, str]]:
    """Return (label, worst value, text of its scenario) for each certified figure but the largest |pole|."""
    return [
        (
            "time constant of the slowest mode around a resonance, ms",
            proof.decay_ms.value,
            str(proof.decay_ms.scenario),
        ),
        ("max |S|", proof.sensitivity.value, str(proof.sensitivity.scenario)),
        ("|S| at the disturbance's frequency", proof.disturbance.value, str(proof.disturbance.scenario)),
        ("noise gain from sensor to v", proof.noise_gain.value, str(proof.noise_gain.scenario)),
    ]


def robust_values(robust: RobustDesign, design: DesignOptions) -> dict[str, object]:
    """Return [axis.controller] as {"form": "zpk", "gain", "zeros", "poles", "method": "matched"}; each root in rad/s as
    a pair [real, imaginary].
    """
    return controller_values(robust.controller, _output(design))


def provenance(robust: RobustDesign, design: DesignOptions, source: str, text: str) -> list[str]:
    """Return comment lines, without #, on the origin of a controller and its certified figures.

    `source` and `text` are the specification's name and content; a comment has the content's SHA-256.
    """
    digest, options = hashlib.sha256(text.encode()).hexdigest(), design.robust
    return [
        f"Found by rtloop {__version__} (`rtloop design robust`) from {source} (SHA-256 {digest[:16]}…), with seed "
        f"{options.seed}",
        f"plant: {formula(design.required_plant.transfer())}",
        f"worst of {robust.certificate.plants} plants:",
        *(f"  {name} {value:.4g} ({scenario})" for name, value, scenario in certified_values(robust.certificate)),
    ]


def _replace_in_axis(text: str, axis: str, parts: Mapping[str, object], comments: list[str]) -> str:
    """Return `text` with `parts` in the named axis and `comments` in place of older comments by the same command.

    Raises ValueError for an unknown axis.
    """
    table = tomllib.loads(text)
    names = [entry.get("name") for entry in table.get("axis", [])]
    if axis not in names:
        raise ValueError(f"axis: {axis!r} is unknown; allowed: {', '.join(map(str, names)) or 'none'}")
    table["axis"] = [{**entry, **parts} if entry.get("name") == axis else entry for entry in table["axis"]]
    return edit_text(_remove_provenance(text, comments[0]), table, comments, [*parts])


def _remove_provenance(text: str, heading: str) -> str:
    """Return `text` without the paragraphs that begin with "# " and the first two words of `heading`: the comments that
    the same command wrote before.
    """
    paragraphs, mark = text.split("\n\n"), "# " + " ".join(heading.split()[:2]) + " "
    return "\n\n".join(paragraph for paragraph in paragraphs if not paragraph.startswith(mark))


def _output(design: DesignOptions) -> OutputOptions:
    """Return the output options of `design` with the method "matched", which recovers the written roots exactly, and
    without `prewarp_hz`.
    """
    return design.controller.model_copy(update={"method": "matched", "prewarp_hz": None})
