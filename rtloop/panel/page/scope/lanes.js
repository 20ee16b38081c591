// Places of the traces: all on one screen with a scale for each unit, or one above the other.

import { Chart, roundLimits } from "../chart.js";
import { make } from "../dom.js";
import { leastSpan } from "../numbers.js";
import { paintTrace } from "./paint.js";


export class Lanes {
  #host;
  #limits = new Map();
  lanes = [];

  constructor(host) {
    this.#host = host;
  }

  /** Lay out anew for traces [{name, unit, colour, dash}]. */
  arrange(traces, stacked) {
    for (const { chart, box } of this.lanes) {
      chart.destroy();
      box.remove();
    }
    const groups = stacked ? traces.map((trace) => [trace]) : [traces];
    this.lanes = groups.filter((group) => group.length).map((group, place) => {
      const box = make("div", { class: "lane" });
      this.#host.append(box);
      const lane = { traces: group, box, id: stacked ? group[0].name : "all", sweeps: [] };
      const units = [...new Set(group.map(({ unit }) => unit))];
      const scales = units.map((unit, number) => ({ key: unit, unit: unit === "1" ? "" : unit, side: number ? 1 : 3 }));
      if (stacked) scales[0].unit = `${group[0].name}${group[0].unit === "1" ? "" : `, ${group[0].unit}`}`;
      lane.units = units;
      lane.bare = place < groups.length - 1;
      lane.scales = scales;
      return lane;
    });
    for (const lane of this.lanes) {
      lane.chart = new Chart(lane.box, {
        x: { values: timeTicks },
        scales: lane.scales,
        bare: lane.bare,
        draw: (chart, ctx) => this.#paint(lane, chart, ctx),
      });
    }
  }

  /** The lane and the scale of a signal; null where it is not shown. */
  of(name) {
    for (const lane of this.lanes) {
      const trace = lane.traces.find((one) => one.name === name);
      if (trace) return { lane, key: trace.unit };
    }
    return null;
  }

  get pixels() {
    return this.lanes[0]?.chart.pixels ?? 800;
  }

  get canvases() {
    return this.lanes.map(({ chart }) => chart.plot.ctx.canvas);
  }

  /** Limits of the scales by "lane/unit", in force. */
  get limits() {
    return this.#limits;
  }

  setLimits(id, low, high) {
    this.#limits.set(id, [low, high]);
  }

  /** Draw [{sweep, faded}], the last one foremost, between two times in s; scales follow where `autoscale`. */
  show(sweeps, [from_s, to_s], autoscale) {
    for (const lane of this.lanes) {
      lane.sweeps = sweeps;
      lane.chart.setRange("x", from_s, to_s);
      for (const unit of lane.units) {
        const id = `${lane.id}/${unit}`;
        if (autoscale || !this.#limits.has(id)) {
          const names = lane.traces.filter((trace) => trace.unit === unit).map(({ name }) => name);
          const [low, high] = extent(sweeps, names);
          this.#limits.set(id, roundLimits(low, high, this.#limits.get(id), leastSpan(unit)));
        }
        lane.chart.setRange(unit, ...this.#limits.get(id));
      }
      lane.chart.show();
    }
  }

  #paint(lane, chart, ctx) {
    for (const { sweep, faded } of lane.sweeps) {
      for (const trace of lane.traces) paintTrace(chart, ctx, sweep, trace, trace.unit, faded);
    }
  }
}

function extent(sweeps, names) {
  let low = Infinity;
  let high = -Infinity;
  for (const { sweep } of sweeps) {
    for (const name of names) {
      for (const value of sweep.arrays[`${name}:low`] ?? []) if (value < low) low = value;
      for (const value of sweep.arrays[`${name}:high`] ?? []) if (value > high) high = value;
    }
  }
  return [low, high];
}

/** In the unit that suits the time base. */
function timeTicks(plot, ticks) {
  const span = plot.scales.x.max - plot.scales.x.min;
  const [factor, unit] = span < 2e-3 ? [1e6, "µs"] : span < 2 ? [1e3, "ms"] : [1, "s"];
  return ticks.map((tick) => `${String(Number((tick * factor).toPrecision(6))).replace("-", "−")} ${unit}`);
}
