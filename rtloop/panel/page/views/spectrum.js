// The density of a signal over frequency, both logarithmic, and its rms between two frequencies.

import { Chart, polyline } from "../chart.js";
import { $, calmly, complain } from "../dom.js";
import { frequency, fromField, significant } from "../numbers.js";
import { palette } from "../palette.js";
import { Picker } from "../picker.js";
import { Line } from "../scope/cursors.js";
import { showFigures } from "./figures.js";

const perRoot = (unit) => `${unit}/√Hz`;

export class Spectrum {
  #live;
  #chart;
  #signal;
  #lines = [];
  #density = null;
  #kept = null;
  #held = false;
  #band_hz = [1, 1000];

  constructor(live, panel) {
    this.#live = live;
    this.#signal = new Picker($("spectrum-signal"), () => {
      this.#density = this.#kept = null;
      this.#ask();
    });
    this.#signal.options = panel.columns.filter(({ name }) => name !== "tick" && name !== "deadline_ns").map(({ name, unit }) => ({ value: name, text: unit === "1" ? name : `${name}, ${unit}` }));
    this.#signal.value = `${panel.axes[0]}_position_um`;
    this.#band_hz[1] = Math.min(1000, panel.rate_hz / 2);
    $("high-hz").value = String(this.#band_hz[1]);
    for (const [place, id] of ["low-hz", "high-hz"].entries()) {
      $(id).addEventListener("change", () => {
        try {
          const value = fromField($(id));
          if (value < 0 || value > panel.rate_hz / 2) throw new Error(`${id === "low-hz" ? "from" : "to"}: ${value} Hz; allowed: 0 … ${panel.rate_hz / 2} Hz`);
          this.#band(place, value);
          complain($("spectrum-error"), null);
        } catch (error) {
          complain($("spectrum-error"), error);
        }
      });
    }
    $("spectrum-reset").addEventListener("click", () => live.once({ reset_spectrum: true }));
    $("spectrum-hold").addEventListener("click", () => {
      this.#held = !this.#held;
      $("spectrum-hold").setAttribute("aria-pressed", String(this.#held));
    });
    $("spectrum-keep").addEventListener("click", () => {
      this.#kept = this.#kept ? null : this.#density;
      $("spectrum-keep").textContent = this.#kept ? "Remove comparison" : "Keep for comparison";
      this.#show();
    });
    live.addEventListener("spectrum", ({ detail }) => {
      if (this.#held || detail.signal !== this.#signal.value) return;
      this.#density = detail;
      requestAnimationFrame(() => this.#show());
    });
  }

  get canvases() {
    return this.#chart ? [this.#chart.plot.ctx.canvas] : [];
  }

  open() {
    this.arrange();
    this.#ask();
  }

  close() {
    this.#live.wish({ spectrum: null });
  }

  arrange() {
    for (const line of this.#lines) line.remove();
    this.#chart?.destroy();
    this.#chart = new Chart($("spectrum-plot"), {
      x: { unit: "Hz", log: true },
      scales: [{ key: "density", unit: this.#density ? perRoot(this.#density.unit) : "", log: true }],
      draw: (chart, ctx) => this.#paint(chart, ctx),
    });
    this.#chart.setRange("x", 0.1, 5000);
    this.#chart.setRange("density", 0.01, 100);
    this.#lines = ["from", "to"].map((name, place) => new Line(this.#chart, {
      key: "x", name: `Band ${name}`, text: name, moved: (hz) => this.#band(place, Number(hz.toPrecision(3))),
    }));
    this.#show();
  }

  #band(place, hz) {
    this.#band_hz[place] = hz;
    $(place ? "high-hz" : "low-hz").value = String(hz);
    this.#ask();
    this.#show();
  }

  #ask = calmly(100, () => {
    const [low_hz, high_hz] = [...this.#band_hz].sort((a, b) => a - b);
    this.#live.wish({ spectrum: { signal: this.#signal.value, low_hz, high_hz } });
  });

  #show() {
    if (!this.#chart || !this.#density) return;
    const { unit, rms, low_hz, high_hz, averages_least, averages_most, bridged } = this.#density;
    const { hz, amplitude } = this.#density.arrays;
    if (this.unit !== unit) {
      this.unit = unit;
      return this.arrange();
    }
    const positive = [...amplitude].filter((value, bin) => hz[bin] > 0 && value > 0);
    if (positive.length) {
      this.#chart.setRange("x", 10 ** Math.floor(Math.log10(hz.find((one) => one > 0))), hz.at(-1));
      const [low, high] = [Math.min(...positive), Math.max(...positive)].map(Math.log10);
      this.#chart.setRange("density", 10 ** Math.floor(low), 10 ** Math.ceil(high + 0.05));
    }
    this.#chart.show();
    $("spectrum-rest").hidden = !this.#density.at_rest;
    for (const [place, line] of this.#lines.entries()) line.place(this.#band_hz[place], frequency(this.#band_hz[place]));
    const segments = averages_least === averages_most ? `${averages_least ?? "—"}` : `${averages_least} at the lowest frequencies … ${averages_most}`;
    showFigures($("spectrum-figures"), {
      [`rms, ${frequency(low_hz, 3)} … ${frequency(high_hz, 3)}`]: `${significant(rms, 4)} ${unit === "1" ? "" : unit}`,
      "segments averaged": segments,
      "density at “from”": `${significant(this.#at(0), 3)} ${perRoot(unit)}`,
      "density at “to”": `${significant(this.#at(1), 3)} ${perRoot(unit)}`,
      ...(bridged ? { "missing ticks interpolated": String(bridged) } : {}),
    });
  }

  #at(place) {
    const { hz, amplitude } = this.#density.arrays;
    const bin = hz.findIndex((one) => one >= this.#band_hz[place]);
    return bin < 0 ? NaN : amplitude[bin];
  }

  #paint(chart, ctx) {
    const ratio = devicePixelRatio;
    const line = ({ arrays: { hz, amplitude } }, colour, dash) => {
      ctx.strokeStyle = colour;
      ctx.lineWidth = 1.5 * ratio;
      ctx.setLineDash(dash.map((length) => length * ratio));
      const level = (bin) => (hz[bin] > 0 && amplitude[bin] > 0 ? chart.at(amplitude[bin], "density") : NaN);
      polyline(ctx, hz.length, (bin) => chart.at(hz[bin], "x"), level);
    };
    if (!this.#density) return;
    const [from, to] = [...this.#band_hz].sort((a, b) => a - b).map((hz) => chart.at(Math.max(hz, 1e-9), "x"));
    ctx.fillStyle = palette().grid;
    ctx.globalAlpha = 0.55;
    ctx.fillRect(from, chart.plot.bbox.top, to - from, chart.plot.bbox.height);
    ctx.globalAlpha = 1;
    if (this.#kept) line(this.#kept, palette().model, [6, 4]);
    line(this.#density, palette().traces[0], []);
  }
}
