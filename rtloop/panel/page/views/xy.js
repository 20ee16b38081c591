// Drive against position, with the loop that the hysteresis model draws over the same drive behind it.

import { Chart, polyline, roundLimits } from "../chart.js";
import { $ } from "../dom.js";
import { duration, fixed, leastSpan, quantity } from "../numbers.js";
import { DASHES, palette } from "../palette.js";
import { Picker } from "../picker.js";
import { showFigures } from "./figures.js";

const TIMES_S = [0.2, 0.5, 1, 2, 5, 10];

export class Xy {
  #live;
  #chart;
  #limits = {};
  #axis;
  #seconds;
  #loop = null;
  #held = false;

  constructor(live, panel) {
    this.#live = live;
    this.#axis = new Picker($("xy-axis"), () => this.open());
    this.#axis.options = panel.axes.map((value) => ({ value, text: value }));
    this.#seconds = new Picker($("xy-seconds"), () => this.open());
    this.#seconds.options = TIMES_S.map((value) => ({ value, text: duration(value, 2) }));
    this.#seconds.value = 1;
    $("xy-hold").addEventListener("click", () => {
      this.#held = !this.#held;
      $("xy-hold").setAttribute("aria-pressed", String(this.#held));
    });
    live.addEventListener("xy", ({ detail }) => this.#take(detail));
  }

  get seconds() {
    return this.#seconds.value;
  }

  get canvases() {
    return this.#chart ? [this.#chart.plot.ctx.canvas] : [];
  }

  open() {
    this.arrange();
    this.#limits = {};
    this.#live.wish({ xy: { axis: this.#axis.value, seconds: this.#seconds.value } });
  }

  close() {
    this.#live.wish({ xy: null });
  }

  arrange() {
    this.#chart?.destroy();
    this.#chart = new Chart($("xy-plot"), {
      x: { unit: `drive of ${this.#axis.value}, V` },
      scales: [{ key: "µm", unit: `position of ${this.#axis.value}, µm` }],
      draw: (chart, ctx) => this.#paint(chart, ctx),
    });
    this.#show();
  }

  #take(loop) {
    if (this.#held) return;
    this.#loop = loop;
    requestAnimationFrame(() => this.#show());
  }

  #show() {
    if (!this.#loop || !this.#chart) return;
    const { drive_v, position_um, model_drive_v = [], model_position_um = [] } = this.#loop.arrays;
    $("xy-model").hidden = !("model_drive_v" in this.#loop.arrays);
    const limits = (key, least, ...values) => {
      const all = values.flatMap((numbers) => [...numbers]).filter(Number.isFinite);
      const [low, high] = all.reduce(([a, b], value) => [Math.min(a, value), Math.max(b, value)], [Infinity, -Infinity]);
      this.#limits[key] = roundLimits(low, high, this.#limits[key], least);
      this.#chart.setRange(key, ...this.#limits[key]);
    };
    limits("x", leastSpan("V", 50), drive_v, model_drive_v);
    limits("µm", leastSpan("µm", 50), position_um, model_position_um);
    this.#chart.show();
    $("xy-rest").hidden = !this.#loop.at_rest;
    showFigures($("xy-figures"), {
      "drive now": `${fixed(drive_v.at(-1), 3)} V`,
      "position now": `${quantity(position_um.at(-1), "µm")} µm`,
      ...(this.#loop.loop_percent == null ? {} : { "width of the loop": `${fixed(this.#loop.loop_percent, 1)} %` }),
    });
  }

  #paint(chart, ctx) {
    if (!this.#loop) return;
    const { drive_v, position_um, model_drive_v, model_position_um } = this.#loop.arrays;
    const ratio = devicePixelRatio;
    const line = (x, y, colour, width, dash) => {
      ctx.strokeStyle = colour;
      ctx.lineWidth = width * ratio;
      ctx.setLineDash(dash.map((length) => length * ratio));
      polyline(ctx, x.length, (point) => chart.at(x[point], "x"), (point) => chart.at(y[point], "µm"));
    };
    if (model_drive_v?.length) line(model_drive_v, model_position_um, palette().model, 2, DASHES[1]);
    line(drive_v, position_um, palette().traces[0], 1.6, []);
    if (!drive_v.length) return;
    ctx.fillStyle = palette().traces[1];
    ctx.beginPath();
    ctx.arc(chart.at(drive_v.at(-1), "x"), chart.at(position_um.at(-1), "µm"), 4.5 * ratio, 0, 2 * Math.PI);
    ctx.fill();
  }
}
