// Margins, step and tolerated shift of the resonance, before and after a change.

import { Chart, polyline, roundLimits } from "../chart.js";
import { $, make } from "../dom.js";
import { fixed, significant } from "../numbers.js";
import { palette } from "../palette.js";

const shift = (range) => (range ? `${significant(range[0], 2)}…+${significant(range[1], 2)} %` : "—");
const width = (range) => (range ? Math.min(-range[0], range[1]) : null);
/** Key of the figures, its name, how it is shown, and whether more of it is better. */
const ROWS = [
  ["gain_margin_db", "gain margin", (value) => `${fixed(value, 2)} dB`, 1],
  ["phase_margin_deg", "phase margin", (value) => `${fixed(value, 1)}°`, 1],
  ["modulus_margin", "modulus margin", (value) => fixed(value, 3), 1],
  ["crossover_hz", "crossover", (value) => `${significant(value, 4)} Hz`, 0],
  ["tolerated_shift_percent", "resonance may shift", shift, 1],
  ["overshoot_percent", "overshoot", (value) => `${fixed(value, 1)} %`, -1],
  ["settling_ms", "settles in", (value) => `${significant(value, 3)} ms`, -1],
];

export class Preview {
  #chart = null;
  #steps = null;
  #limits = null;

  arrange() {
    this.#chart?.destroy();
    this.#chart = null;
    if (this.#steps) this.#draw();
  }

  /** Show two sets of figures; null is what does not exist. Nothing is better of a loop that never settles. */
  show(before, after) {
    const settles = after?.settling_ms != null;
    $("preview-figures").tBodies[0].replaceChildren(...ROWS.map(([key, name, text, better]) => {
      const [now, then] = [before?.[key], after?.[key]];
      const [a, b] = Array.isArray(now) || Array.isArray(then) ? [width(now), width(then)] : [now, then];
      const differs = a != null && b != null && text(now) !== text(then); // an arrow beside equal figures would mislead
      const changed = differs ? Math.min(Math.sign(b - a) * better, settles ? 1 : 0) : 0;
      const arrow = changed > 0 ? " ▲" : changed < 0 ? " ▼" : "";
      const cell = make("td", { class: changed > 0 ? "better" : changed < 0 ? "worse" : null }, then == null ? "—" : text(then) + arrow);
      if (arrow) cell.append(make("span", { class: "unseen" }, changed > 0 ? "better" : "worse"));
      return make("tr", {}, make("th", { scope: "row" }, name), make("td", {}, now == null ? "—" : text(now)), cell);
    }));
    $("preview-problems").replaceChildren(...(after?.problems ?? []).map((problem) => make("li", {}, problem)));
    this.#steps = { before: before?.step, after: after?.step };
    this.#limits = null;
    this.#draw();
  }

  #draw() {
    this.#chart ??= new Chart($("preview-plot"), {
      x: { unit: "ms" },
      scales: [{ key: "µm", unit: "" }],
      draw: (chart, ctx) => this.#paint(chart, ctx),
    });
    const steps = Object.values(this.#steps).filter((step) => step?.t_ms?.length);
    if (!steps.length) return;
    const levels = steps.flatMap(({ y }) => y).filter((value) => Number.isFinite(value) && Math.abs(value) < 5);
    this.#limits = roundLimits(Math.min(0, ...levels), Math.max(1, ...levels), this.#limits);
    this.#chart.setRange("x", 0, Math.max(...steps.map(({ t_ms }) => t_ms.at(-1))));
    this.#chart.setRange("µm", ...this.#limits);
    this.#chart.show();
  }

  #paint(chart, ctx) {
    const ratio = devicePixelRatio;
    const line = (step, colour, dash) => {
      if (!step?.t_ms?.length) return;
      ctx.strokeStyle = colour;
      ctx.lineWidth = 1.6 * ratio;
      ctx.setLineDash(dash.map((length) => length * ratio));
      polyline(ctx, step.t_ms.length, (point) => chart.at(step.t_ms[point], "x"), (point) => chart.at(step.y[point] ?? NaN, "µm"));
    };
    line(this.#steps?.before, palette().model, [5, 3]);
    line(this.#steps?.after, palette().traces[0], []);
  }
}
