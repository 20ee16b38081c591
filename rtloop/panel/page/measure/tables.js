// Figures of a measurement as tables; an unknown figure is a dash.

import { $, make } from "../dom.js";
import { fixed, significant } from "../numbers.js";
import { showFigures } from "../views/figures.js";

const plain = (value) => value;
const decibel = (ratio) => 20 * Math.log10(ratio);
/** Key, name, unit, decimals or null for significant digits, and how a ratio is shown in decibel. */
const MARGINS = [
  ["crossover_hz", "crossover", "Hz", null],
  ["gain_margin", "gain margin", "dB", 2, decibel],
  ["gain_margin_hz", "– at the frequency", "Hz", null],
  ["phase_margin_deg", "phase margin", "°", 2],
  ["modulus_margin", "modulus margin", "", 3],
  ["max_sensitivity", "largest |S|", "dB", 2, decibel],
  ["max_sensitivity_hz", "– at the frequency", "Hz", null],
];
/** Residuals over the uncertainty up to which the stage counts as linear. */
const LARGEST_MISFIT = 2;
const row = (name, ...cells) => make("tr", {}, make("th", { scope: "row" }, name), ...cells.map((cell) => (cell instanceof Node ? cell : make("td", {}, cell))));

/** Margins measured, with ± one standard deviation, beside the model's, where `margins`; the lightly damped mode below. */
export function showMargins({ margins, model, resonance, lines, periods, from_hz, to_hz, moved_um }, all) {
  $("measured-margins").hidden = !all;
  $("measured-margins").tBodies[0].replaceChildren(...MARGINS.map(([key, name, unit, decimals, convert = plain]) => {
    const { value, std } = margins[key];
    const promised = model?.margins[key] ?? null;
    const text = (number) => (number == null ? "—" : `${decimals === null ? significant(number, 4) : fixed(number, decimals)} ${unit}`);
    const spread = value == null || std == null ? null : convert === plain ? std : (decibel(Math.E) * std) / value;
    return row(name, text(value == null ? null : convert(value)), spread == null ? "—" : `± ${significant(spread, 2)}`, text(promised == null ? null : convert(promised)));
  }));
  showFigures($("measured-figures"), {
    ...(resonance ? {
      "lightly damped mode": `${significant(resonance.hz, 6)} ± ${significant(resonance.hz_std, 2)} Hz`,
      damping: `${significant(resonance.damping, 4)} ± ${significant(resonance.damping_std, 2)}`,
      ...(resonance.misfit > LARGEST_MISFIT ? { linear: "no; hysteresis is left, and these figures are valid for this motion alone" } : {}),
    } : { "lightly damped mode": "none stands out" }),
    "position moved by": `${significant(moved_um, 3)} µm`,
    lines: `${lines} from ${significant(from_hz, 3)} to ${significant(to_hz, 3)} Hz, ${periods} periods`,
  });
}

/** Key, name, text, of a step there; less is better in each. */
const STEP = [
  ["settling_ms", "settles in", (value) => `${significant(value, 4)} ms`],
  ["overshoot", "overshoot", (value) => `${fixed(100 * value, 3)} %`],
  ["highest_command", "largest command per unit", (value) => significant(value, 4)],
];

/** A step on the stage as it was measured, with the present taps and with new ones. */
export function showRetuned({ resonance, percent_from_model, before, after }) {
  const sign = percent_from_model < 0 ? "" : "+";
  showFigures($("retuned-figures"), { resonance: `${significant(resonance.hz, 6)} ± ${significant(resonance.hz_std, 2)} Hz`, "difference from the model's": `${sign}${fixed(percent_from_model, 2)} %` });
  $("retuned-steps").tBodies[0].replaceChildren(...STEP.map(([key, name, text]) => {
    const [now, then] = [before[key], after[key]];
    const change = key === "highest_command" ? 0 : Math.sign(Number((now - then).toPrecision(4)));
    const cell = make("td", { class: change > 0 ? "better" : change < 0 ? "worse" : null }, text(then) + (change > 0 ? " ▲" : change < 0 ? " ▼" : ""));
    if (change) cell.append(make("span", { class: "unseen" }, change > 0 ? "better" : "worse"));
    return row(name, text(now), cell);
  }));
}

/** Errors of a learning from cycle to cycle. */
export function showLearned({ cycles, ended }) {
  const least = cycles.reduce((best, { rms_um }, place) => (rms_um < cycles[best].rms_um ? place : best), 0);
  showFigures($("learned-figures"), { ended, "best cycle": String(least), "rms error of that cycle": `${fixed(1e3 * cycles[least].rms_um, 1)} nm` });
  $("learned-cycles").tBodies[0].replaceChildren(...cycles.map(({ rms_um, largest_um }, place) => row(place ? String(place) : "0, nothing learned", `${fixed(1e3 * rms_um, 1)} nm`, `${fixed(1e3 * largest_um, 1)} nm`)));
}
