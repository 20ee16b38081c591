// The cursors of the scope, two in time and two in value, and the level of its trigger, over all lanes.

import { $, say } from "../dom.js";
import { duration, frequency, quantity } from "../numbers.js";
import { Picker } from "../picker.js";
import { Line } from "./cursors.js";

const PLACES = [0.25, 0.75];
/** Of the screen, where cursors are put at first. */

export class Markers {
  #lanes;
  #lines = [];
  #valueOf;
  #levels = null;
  #shown = "";
  #changed;
  #setLevel;
  #view = null;
  #span = [0, 1];
  /** Two times in s, or null where the cursors are off. */
  times = null;

  /** `changed` is called when a cursor was moved, `setLevel(level)` when the trigger's level was. */
  constructor(lanes, changed, setLevel) {
    this.#lanes = lanes;
    this.#changed = changed;
    this.#setLevel = setLevel;
    this.#valueOf = new Picker($("value-of"), () => this.arrange(this.#view, this.#span));
  }

  toggle() {
    this.times = this.times ? null : this.#within(this.#span);
    this.#levels = null;
    this.arrange(this.#view, this.#span);
  }

  /** Lay out anew for what is asked of the scope, shown between two times in s. */
  arrange(view, span) {
    const moved = this.#span.join() !== span.join();
    this.#view = view;
    this.#span = span;
    if (this.times && moved) this.times = this.#within(span);
    this.#valueOf.options = view.signals.map((name) => ({ value: name, text: name }));
    for (const { line } of this.#lines) line.remove();
    this.#lines = [];
    $("cursors").setAttribute("aria-pressed", String(this.times !== null));
    $("scope").classList.toggle("no-cursors", this.times === null);
    this.#addTrigger();
    if (this.times) this.#addCursors();
    this.#changed();
  }

  /** Put them where they belong on the axes as they are now. */
  place() {
    for (const { line, value, says } of this.#lines) line.place(value(), says(value()));
    if (this.times) this.#say();
  }

  #within([from, to]) {
    return PLACES.map((place) => from + place * (to - from));
  }

  #add(chart, options, value, says) {
    this.#lines.push({ line: new Line(chart, options), value, says });
  }

  #addTrigger() {
    const { mode, kind, source, level } = this.#view.trigger;
    const shown = this.#lanes.of(source);
    if (mode === "roll" || kind !== "edge" || !shown) return;
    const options = { key: shown.key, name: "Trigger level", text: "T", kind: "trigger", moved: this.#setLevel };
    this.#add(shown.lane.chart, options, () => level, (value) => quantity(value, shown.key));
  }

  #addCursors() {
    for (const [number, text] of ["A", "B"].entries()) {
      for (const [place, lane] of this.#lanes.lanes.entries()) {
        const moved = (time_s) => this.#moved(this.times, number, time_s);
        this.#add(lane.chart, { key: "x", name: `Cursor ${text}`, text, moved, reachable: place === 0 }, () => this.times[number], (time_s) => duration(time_s));
      }
    }
    const shown = this.#lanes.of(this.#valueOf.value);
    if (!shown) return;
    this.#levels = null;
    this.#shown = `${shown.lane.id}/${shown.key}`;
    for (const [number, text] of ["1", "2"].entries()) {
      const moved = (value) => this.#moved(this.#levels, number, value);
      const level = () => (this.#levels ??= this.#within(this.#lanes.limits.get(this.#shown)))[number];
      this.#add(shown.lane.chart, { key: shown.key, name: `Cursor ${text}`, text, moved }, level, (value) => `${quantity(value, shown.key)} ${shown.key}`);
    }
  }

  #moved(values, number, value) {
    values[number] = value;
    this.#changed();
  }

  #say() {
    const [a, b] = this.times;
    const unit = this.#lanes.of(this.#valueOf.value)?.key;
    const level = (number) => quantity(this.#levels[number], unit);
    const levels = this.#levels && unit ? ` · 1 ${level(0)}, 2 ${level(1)}, Δ ${quantity(this.#levels[1] - this.#levels[0], unit)} ${unit}` : "";
    say($("measured"), `A ${duration(a)}, B ${duration(b)}, Δt ${duration(b - a)}, 1/Δt ${frequency(1 / Math.abs(b - a))}${levels}`);
  }
}
