// Figures beneath the plot: of the envelope at once, of every tick when the server has sent them.

import { get } from "../api.js";
import { $, calmly, say } from "../dom.js";
import { counted, duration } from "../numbers.js";
import { isDecimated, Table } from "./table.js";

export class Figures {
  #table = new Table();
  #shown = null;
  #exact = null;

  /** A row for each trace; `remove(name)` takes one away. */
  arrange(traces, remove) {
    this.#table.arrange(traces, remove);
  }

  /** Of signals of a sweep between two times in s; five times a second at most. */
  show = calmly(200, (sweep, signals, window) => {
    this.#shown = { sweep, window, of: stretch(sweep, signals, window) };
    this.#fill();
    const { trigger, uncertain_ticks, rate_hz, number } = sweep;
    say($("sweep-says"), `${number ? `sweep ${counted(number)} ` : ""}at tick ${counted(trigger)}${uncertain_ticks ? `, or up to ${uncertain_ticks} before` : ""}; ${duration(perPoint(sweep) / rate_hz, 3)} a point`);
    this.#measureSoon();
  });

  #fill() {
    const { sweep, window, of } = this.#shown;
    this.#table.show(sweep, window, this.#exact?.of === of ? this.#exact.figures : null);
  }

  /** An envelope tells rms and σ only about; of a sweep that is still being taken there is nothing else. */
  #measureSoon = calmly(400, async () => {
    const { sweep, of } = this.#shown;
    if (!sweep.complete || !isDecimated(sweep) || of === this.#exact?.of) return;
    try {
      this.#exact = { of, figures: await get(`/api/measure?${of}`) };
    } catch {
      this.#exact = null; // its ticks are not kept any more
    }
    this.#fill();
  });
}

function perPoint({ arrays: { offset } }) {
  return offset.length > 1 ? (offset[offset.length - 1] - offset[0]) / (offset.length - 1) : 1;
}

/** What is asked of the server for exact figures between two times in s, both ticks included. */
function stretch({ run, trigger, rate_hz, first, end }, signals, [from_s, to_s]) {
  const tick = (time_s) => Math.min(Math.max(trigger + Math.round(time_s * rate_hz), first, 0), end - 1);
  return `run=${run}&first=${tick(from_s)}&end=${tick(to_s) + 1}&signals=${signals}`;
}
