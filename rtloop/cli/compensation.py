"""`rtloop design compensation`: hysteresis that the inverse of a configuration leaves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.identify import PLOT
from rtloop.cli.options import CONFIG, JSON, OUTPUT
from rtloop.cli.output import print_result, print_warnings
from rtloop.errors import ConfigError
from rtloop.values import to_jsonable
from rtloop.workbench.hysteresis_text import print_files
from rtloop.workbench.tables import console, table

RANDOM_COMMANDS = 20_000


@click.command()
@CONFIG
@click.option(
    "--actuator",
    type=OUTPUT,
    required=True,
    help="File with the actuator's [axis.feedforward], identified from another recording than the inverse of CONFIG.",
)
@click.option("--axis", help="Name of the axis.  [default: the first axis]")
@click.option(
    "--command-um",
    type=click.FloatRange(0, min_open=True),
    help="Largest command |v|, in µm, for the bound and the simulation.  [default: limits.command_um]",
)
@PLOT
@JSON
@report_errors
def compensation(as_json: bool, **options: Any) -> None:
    """Compute the hysteresis that the inverse of CONFIG leaves.

    Prints the gain ρ, the remaining hysteresis Ω = y − ρ v (command v, output y) and its bound ξ. The file of
    --actuator holds the best known model of the real actuator: identified from another recording than the inverse of
    CONFIG, or the model of a simulated rig. With the model from which CONFIG's inverse is computed, only the dead band
    is left, and a warning says so.
    """
    print_result(compensation_report(**options), as_json, _print_compensation)


def compensation_report(
    config: Path,
    actuator: Path,
    axis: str | None = None,
    command_um: float | None = None,
    plot: Path | None = None,
) -> dict[str, object]:
    """Bound and simulate the hysteresis that the inverse in `config` leaves in the identified `actuator`.

    Returns the JSON report. Its `bounds` have a row for each choice of the gain ρ: {gain ("eq_2", "best" or "unity"),
    rho, xi_um: the bound ξ, simulated_um: {sine, random, worst_case}, the largest |Ω| = |y − ρ v|, y being the output
    for a command v}. Further keys: config, identified, command_um, thresholds_um, weights, eq_3_um and
    triangle_bound_um (other bounds), dead_band, same_model (whether the inverse is computed from the actuator's own
    model), plot.

    `axis` None is the first axis. `command_um` is the largest |v| (None: the axis's limit). Writes a picture to `plot`,
    if given. Raises ConfigError for a file without a hysteresis model of the axis and for a compensator whose loading
    curve does not increase, RecordingError for an unreadable file, OutputError and MissingExtra for the picture.
    """
    import numpy as np

    from rtloop.configuration.file import load
    from rtloop.design.identification.model_sections import read_feedforward
    from rtloop.hysteresis.compensation import compensated_output, residual_operator

    compensator, identified = read_feedforward(config, axis), read_feedforward(actuator, axis)
    if command_um is None:
        axes = load(config).axes
        command_um = next(entry for entry in axes if axis in (None, entry.name)).limits.command_um
    model, (_, inverse) = identified.actuator(), compensator.models()
    own_model = compensator.actuator()
    try:
        residual = residual_operator(model, inverse, command_um)
    except ValueError as fault:
        raise ConfigError(str(config), [f"axis.feedforward: {fault}"]) from None
    commands = {
        "sine": command_um * np.sin(np.linspace(0, 5 * np.pi, RANDOM_COMMANDS)),
        "random": np.random.default_rng(0).uniform(-command_um, command_um, RANDOM_COMMANDS),
    }
    gains = {"eq_2": residual.gain, "best": residual.best_gain, "unity": 1.0}
    rows = []
    for name, gain in gains.items():
        simulated = {
            key: float(np.abs(compensated_output(model, inverse, v) - gain * v).max())
            for key, v in {**commands, "worst_case": residual.worst_commands_um(gain)}.items()
        }
        rows.append({"gain": name, "rho": gain, "xi_um": residual.bound_um(gain), "simulated_um": simulated})
    if plot is not None:
        from rtloop.design.identification.plots import plot_compensation

        plot_compensation(residual, model, inverse, plot)
    return to_jsonable(
        {
            "config": config,
            "identified": actuator,
            "command_um": command_um,
            "thresholds_um": residual.operator.thresholds,
            "weights": residual.operator.weights,
            "bounds": rows,
            "eq_3_um": residual.printed_bound_um,
            "triangle_bound_um": residual.safe_bound_um,
            "dead_band": compensator.dead_band,
            "same_model": np.array_equal(model.thresholds, own_model.thresholds)
            and np.array_equal(model.weights, own_model.weights),
            "plot": plot,
        }
    )


def _print_compensation(report: dict[str, Any]) -> None:
    """Print, for each gain ρ, the bound ξ of eq (2) beside simulated deviations; then other bounds, and notes."""
    out = console()
    rows = table("ρ", "value", "ξ µm", "sine µm", "random µm", "worst case µm")
    for row in report["bounds"]:
        simulated = row["simulated_um"]
        values = (row["rho"], row["xi_um"], simulated["sine"], simulated["random"], simulated["worst_case"])
        rows.add_row(row["gain"].replace("_", " "), *(f"{value:.4f}" for value in values))
    out.print(f"|v| ≤ {report['command_um']:g} µm: largest |Ω| = |y − ρ v|, bound ξ and simulated")
    out.print(rows)
    out.print(
        f"eq (3) of the paper gives {report['eq_3_um']:.4f} µm, which is no bound where the weights have both signs; "
        f"Σ ζ|w| (thresholds ζ, weights w) = {report['triangle_bound_um']:.4f} µm is a bound for all weights"
    )
    if report["same_model"]:
        print_warnings(
            [
                "the actuator equals the model from which the inverse is computed. The deviations show only the dead "
                "band below the first threshold, and no error of the model. To include the error of the model, use "
                "--actuator FILE, where FILE contains the model identified from another recording"
            ]
        )
    if report["dead_band"] == "exact":
        out.print(
            f"these figures leave out dead_band = 'exact', which {report['config']} sets: in a run, less hysteresis "
            "remains"
        )
    print_files(out, report)
