// Figures beside the plot: each trace between the cursors, or on the whole screen.

import { $, make, say } from "../dom.js";
import { quantity } from "../numbers.js";
import { measure, valueAt } from "./measure.js";

const FIGURES = ["low", "high", "mean", "rms", "deviation", "peak_to_peak"];

/** A short line as the trace is drawn. */
export function swatch(trace) {
  const ns = "http://www.w3.org/2000/svg";
  const picture = document.createElementNS(ns, "svg");
  for (const [name, value] of Object.entries({ width: 30, height: 10, class: "swatch ink", "aria-hidden": "true" })) picture.setAttribute(name, value);
  const line = document.createElementNS(ns, "path");
  const drawn = { d: "M1 5H29", stroke: trace.colour, "stroke-width": 2.5, "stroke-dasharray": trace.dash.join(" ") || "none" };
  for (const [name, value] of Object.entries(drawn)) line.setAttribute(name, value);
  picture.append(line);
  return picture;
}

export class Table {
  #rows = new Map();

  /** A row for each trace; `remove(name)` takes one away. */
  arrange(traces, remove) {
    this.#rows.clear();
    const body = $("traces").tBodies[0];
    body.replaceChildren(...traces.map((trace) => {
      const cells = [...FIGURES, "a", "b", "difference"].map((figure, place) => make("td", place >= FIGURES.length ? { class: "cursor-only" } : {}, "—"));
      const button = make("button", { type: "button", "aria-label": `Remove ${trace.name}`, click: () => remove(trace.name) }, "×");
      this.#rows.set(trace.name, { trace, cells });
      return make("tr", {}, make("th", { scope: "row" }, swatch(trace), trace.name), make("td", {}, trace.unit === "1" ? "" : trace.unit), ...cells, make("td", {}, button));
    }));
  }

  /** Fill it from a sweep, between two times in s; `exact` are figures of all ticks there, by signal, or null. */
  show(sweep, [from_s, to_s], exact) {
    for (const [name, { trace, cells }] of this.#rows) {
      const seen = measure(sweep, name, from_s, to_s);
      const all = exact?.[name];
      const figures = all ? { ...all, deviation: all.std, exact: true } : seen;
      if (figures) figures.peak_to_peak = figures.high - figures.low;
      const about = (figure) => (figures && !figures.exact && (figure === "rms" || figure === "deviation" || figure === "mean") ? "≈" : "");
      for (const [place, figure] of FIGURES.entries()) {
        say(cells[place], figures ? about(figure) + quantity(figures[figure], trace.unit) : "—");
      }
      const [a, b] = [valueAt(sweep, name, from_s), valueAt(sweep, name, to_s)];
      for (const [place, value] of [a, b, b - a].entries()) say(cells[FIGURES.length + place], quantity(value, trace.unit));
    }
  }
}

/** Whether figures of the envelope alone would be but near. */
export function isDecimated(sweep) {
  const { offset } = sweep.arrays;
  return offset.length > 1 && offset[offset.length - 1] - offset[0] > offset.length - 1;
}
