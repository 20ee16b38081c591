// |L| and |S| over frequency, in dB: measured with ± two standard deviations, and the model's dashed.

import { Chart, polyline } from "../chart.js";
import { $ } from "../dom.js";
import { palette } from "../palette.js";

const SPREADS = 2;
const LEAST_DB = -80;
const decibel = (pairs) => pairs.map(([re, im]) => 20 * Math.log10(Math.hypot(re, im)));
/** Key of the curve, its spread and the model's, where it is drawn, and its name. */
const PLOTS = [
  ["loop", "loop_spread", "model_loop", "measured-loop", "|L|, dB"],
  ["sensitivity", "sensitivity_spread", "model_sensitivity", "measured-sensitivity", "|S|, dB"],
];

export class Curves {
  #charts = [];
  #found = null;

  get canvases() {
    return this.#charts.map((chart) => chart.plot.ctx.canvas);
  }

  /** Show the response of a measurement. */
  show(found) {
    this.#found = found;
    this.arrange();
  }

  arrange() {
    for (const chart of this.#charts) chart.destroy();
    this.#charts = this.#found ? PLOTS.map((plot) => this.#chart(plot)) : [];
  }

  #chart([key, spreadKey, modelKey, host, unit]) {
    const { hz, [key]: pairs, [spreadKey]: spread, [modelKey]: model } = this.#found.response;
    const [measured, promised] = [decibel(pairs), model ? decibel(model) : []];
    const chart = new Chart($(host), {
      x: { unit: "Hz", log: hz.at(-1) > 10 * hz[0] }, // a band without a decade would be lost on a scale of whole ones
      scales: [{ key: "dB", unit, unitRight: true }], // |L| begins in the left corner
      draw: (chart, ctx) => paint(chart, ctx, { hz, measured, spread, promised, mode_hz: this.#found.resonance?.hz }),
    });
    const levels = [...measured, ...promised, 0].filter((level) => Number.isFinite(level) && level > LEAST_DB);
    chart.setRange("x", hz[0], hz.at(-1));
    chart.setRange("dB", 10 * Math.floor(Math.min(...levels) / 10 - 0.1), 10 * Math.ceil(Math.max(...levels) / 10 + 0.1));
    chart.show();
    return chart;
  }
}

function paint(chart, ctx, { hz, measured, spread, promised, mode_hz }) {
  const ratio = devicePixelRatio;
  const { bbox } = chart.plot;
  const stroke = (colour, width, dash) => {
    ctx.strokeStyle = colour;
    ctx.lineWidth = width * ratio;
    ctx.setLineDash(dash.map((length) => length * ratio));
  };
  const at = (point) => chart.at(hz[point], "x");
  stroke(palette().text, 1, []);
  polyline(ctx, 2, (end) => bbox.left + end * bbox.width, () => chart.at(0, "dB"));
  if (mode_hz) {
    stroke(palette().cursor, 1, [3, 3]);
    polyline(ctx, 2, () => chart.at(mode_hz, "x"), (end) => bbox.top + end * bbox.height);
  }
  const edge = (sign) => (point) => chart.at(measured[point] + 20 * Math.log10(Math.max(1 + sign * SPREADS * spread[point], 1e-3)), "dB");
  ctx.fillStyle = palette().traces[0];
  ctx.globalAlpha = 0.25;
  ctx.beginPath();
  for (let point = 0; point < hz.length; point++) ctx.lineTo(at(point), edge(1)(point));
  for (let point = hz.length - 1; point >= 0; point--) ctx.lineTo(at(point), edge(-1)(point));
  ctx.fill();
  ctx.globalAlpha = 1;
  stroke(palette().model, 2, [6, 4]);
  polyline(ctx, promised.length, at, (point) => chart.at(promised[point], "dB"));
  stroke(palette().traces[0], 1.5, []);
  polyline(ctx, hz.length, at, (point) => chart.at(measured[point], "dB"));
}
