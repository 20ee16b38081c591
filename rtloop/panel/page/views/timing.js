// Lateness of the ticks of the last minute, and advice if it grows.

import { Chart } from "../chart.js";
import { $, make } from "../dom.js";
import { fixed } from "../numbers.js";
import { palette } from "../palette.js";
import { showFigures } from "./figures.js";

export class Timing {
  #live;
  #chart;
  #seen = null;

  constructor(live) {
    this.#live = live;
    live.addEventListener("timing", ({ detail }) => {
      this.#seen = detail;
      requestAnimationFrame(() => this.#show());
    });
  }

  get canvases() {
    return this.#chart ? [this.#chart.plot.ctx.canvas] : [];
  }

  open() {
    this.arrange();
    this.#live.wish({ timing: true });
  }

  close() {
    this.#live.wish({ timing: false });
  }

  arrange() {
    this.#chart?.destroy();
    this.#chart = new Chart($("timing-plot"), {
      x: { unit: "lateness, µs", log: true },
      scales: [{ key: "ticks", unit: "ticks", log: true }],
      draw: (chart, ctx) => this.#paint(chart, ctx),
    });
    this.#show();
  }

  #show() {
    if (!this.#chart || !this.#seen) return;
    const { edges_us, counts } = this.#seen.arrays;
    const first = edges_us.find((edge) => edge > 0) ?? 0.1;
    const last = edges_us[counts.findLastIndex((count) => count > 0) + 1] ?? 1e3;
    this.#chart.setRange("x", first, Math.max(10 ** Math.ceil(Math.log10(last) + 0.05), 1e3));
    this.#chart.setRange("ticks", 0.5, Math.max(10, 10 ** Math.ceil(Math.log10(Math.max(...counts, 1)) + 0.05)));
    this.#chart.show();
    const { worst_us, p50_us, p99_us, periods_missed, exec_p50_us, exec_p99_us, window_s, advice } = this.#seen;
    const us = (value) => `${fixed(value, 1)} µs`;
    showFigures($("timing-figures"), {
      "lateness, median": us(p50_us), "99 % of the ticks below": us(p99_us), "largest lateness": us(worst_us),
      "periods missed": String(periods_missed ?? "—"), "execution time, median": us(exec_p50_us), "99 % of the executions below": us(exec_p99_us), "time span": `${fixed(window_s, 0)} s`,
    });
    const said = advice?.length ? advice : [counts.some(Boolean) ? "Ticks are on time." : "The loop has not executed a tick yet."];
    if ($("advice").textContent !== said.join("")) $("advice").replaceChildren(...said.map((line) => make("li", {}, String(line))));
  }

  #paint(chart, ctx) {
    if (!this.#seen) return;
    const { edges_us, counts } = this.#seen.arrays;
    const [lowest, highest] = chart.range("x");
    const ground = chart.at(0.5, "ticks");
    const bound = (edge) => chart.at(Math.min(Math.max(edge, lowest), highest), "x");
    ctx.fillStyle = palette().traces[0];
    ctx.globalAlpha = 0.8;
    for (let bar = 0; bar < counts.length; bar++) {
      if (!(counts[bar] > 0)) continue;
      const [left, right, top] = [bound(edges_us[bar]), bound(edges_us[bar + 1]), chart.at(counts[bar], "ticks")];
      ctx.fillRect(left, top, Math.max(right - left - devicePixelRatio, devicePixelRatio), ground - top);
    }
    ctx.globalAlpha = 1;
    ctx.lineWidth = devicePixelRatio;
    ctx.strokeStyle = palette().strong;
    ctx.setLineDash([4 * devicePixelRatio, 3 * devicePixelRatio]);
    for (const mark of [this.#seen.p50_us, this.#seen.p99_us]) {
      if (!(mark > 0)) continue;
      ctx.beginPath();
      ctx.moveTo(bound(mark), chart.plot.bbox.top);
      ctx.lineTo(bound(mark), ground);
      ctx.stroke();
    }
  }
}
