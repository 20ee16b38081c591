// The scope: its subscription, the sweeps that arrive, and their display.

import { $, calmly, say } from "../dom.js";
import { DASHES, palette } from "../palette.js";
import { Picker } from "../picker.js";
import { Figures } from "./figures.js";
import { Lanes } from "./lanes.js";
import { Markers } from "./markers.js";
import { showScales } from "./scales.js";
import { remember, remembered } from "./settings.js";
import { SuitedTrigger } from "./suited.js";
import { Trigger } from "./trigger.js";

const MOST_TRACES = 8;
const OVERLAYS = [0, 1, 3, 7, 15, 31];

export class Scope {
  #live;
  #panel;
  #view;
  #lanes = new Lanes($("scope-plot"));
  #figures = new Figures();
  #older = [];
  #reference = null;
  #drawing = false;
  #isSilent = false; // no sweeps are sent
  /** Whether a single sweep is still to come. */
  #armed = true;
  #silence = null;
  #markers;
  #add;
  #overlays;
  sweep = null;
  held = false;

  constructor(live, panel) {
    this.#live = live;
    this.#panel = panel;
    this.#view = remembered(panel);
    this.trigger = new Trigger(this.#view, panel.columns, panel.longest_s, () => {
      this.#armed = true;
      this.#asked();
    });
    new SuitedTrigger(live, panel, this.#view, this.trigger);
    this.#add = new Picker($("add-trace"), (name) => this.#traces([...this.#view.signals, name]));
    this.#markers = new Markers(this.#lanes, () => this.#later(), (level) => this.trigger.setLevel(level));
    this.#overlays = new Picker($("overlay"), (count) => this.#keep({ overlay: count }));
    this.#overlays.options = OVERLAYS.map((value) => ({ value, text: value ? `+ last ${value}` : "no overlay" }));
    this.#overlays.value = this.#view.overlay;
    $("stacked").addEventListener("click", () => {
      this.#keep({ stacked: !this.#view.stacked });
      this.arrange();
    });
    $("autoscale").addEventListener("click", () => {
      this.#keep({ autoscale: !this.#view.autoscale });
      if (this.#view.autoscale) this.#lanes.limits.clear(); // else those in force stay
      this.arrange();
    });
    $("cursors").addEventListener("click", () => this.#markers.toggle());
    $("hold").addEventListener("click", () => this.toggleHold());
    $("force").addEventListener("click", () => live.once({ force: true }));
    $("arm-single").addEventListener("click", () => {
      this.#armed = true;
      live.once({ arm: true });
      this.#waits();
    });
    $("no-comparison").addEventListener("click", () => this.compare(null));
    new ResizeObserver(calmly(300, () => this.#ask())).observe($("scope-plot"));
    live.addEventListener("sweep", ({ detail }) => this.#take(detail));
    this.arrange();
    this.#ask();
  }

  get view() {
    return this.#view;
  }

  get pixels() {
    return Math.round(Math.min(Math.max(this.#lanes.pixels || 1200, 200), 4000));
  }

  get canvases() {
    return this.#lanes.canvases;
  }

  /** Show a sweep of a recording behind the present ones, `says` where it is from; null shows none. */
  compare(sweep, says = "") {
    this.#reference = sweep;
    $("comparing").hidden = !sweep;
    say($("comparing").firstElementChild, says);
    this.#later();
  }

  /** Draw what came last, as after it was out of sight; out of sight no sweeps are sent. */
  redraw() {
    this.#wishSweeps();
    this.#later();
  }

  #wishSweeps() {
    const hold = !!this.held || $("scope").hidden;
    if (hold === this.#isSilent) return;
    this.#isSilent = hold;
    this.#live.wish({ hold });
  }

  toggleHold() {
    this.held = !this.held;
    $("hold").setAttribute("aria-pressed", String(this.held));
    this.#wishSweeps();
  }

  /** Lay out plots and tables anew, as after a change of the theme. */
  arrange() {
    const units = Object.fromEntries(this.#panel.columns.map(({ name, unit }) => [name, unit]));
    this.traces = this.#view.signals.map((name, place) => ({ name, unit: units[name], colour: palette().traces[place], dash: DASHES[place] }));
    this.#lanes.arrange(this.traces, this.#view.stacked);
    $("stacked").setAttribute("aria-pressed", String(this.#view.stacked));
    $("autoscale").setAttribute("aria-pressed", String(this.#view.autoscale));
    this.#figures.arrange(this.traces, (gone) => this.#traces(this.#view.signals.filter((name) => name !== gone)));
    const free = this.#panel.columns.filter(({ name }) => !this.#view.signals.includes(name));
    free.sort((one, other) => this.#ofTheHost(one) - this.#ofTheHost(other)); // the axes' first
    this.#add.options = [{ value: "", text: "a trace…" }, ...free.map(({ name, unit }) => ({ value: name, text: unit === "1" ? name : `${name}, ${unit}` }))];
    this.#add.value = "";
    this.#add.disabled = this.#view.signals.length >= MOST_TRACES;
    this.#markers.arrange(this.#view, this.#span());
    this.#show();
    showScales(this.#lanes, this.#view.autoscale, () => this.#later());
  }

  /** A signal of no axis. */
  #ofTheHost({ name }) {
    return !this.#panel.axes.some((axis) => name.startsWith(`${axis}_`));
  }

  #keep(changes) {
    Object.assign(this.#view, changes);
    remember(this.#view);
    this.#later();
  }

  #traces(signals) {
    if (!signals.length) return;
    this.#keep({ signals });
    this.arrange();
    this.#asked();
  }

  #asked() {
    this.#older = [];
    this.#keep({});
    this.#markers.arrange(this.#view, this.#span());
    this.#ask();
  }

  #ask = calmly(120, () => {
    const { signals, seconds, trigger } = this.#view;
    this.#live.wish({ view: { signals, seconds, pixels: this.pixels, trigger } });
  });

  #take(sweep) {
    if (this.held) return;
    if (this.sweep && this.sweep.trigger !== sweep.trigger) this.#older = [...this.#older, this.sweep].slice(-OVERLAYS.at(-1));
    this.sweep = sweep;
    const words = { trigger: "triggered", forced: "forced", auto: "auto" };
    say($("trigger-state"), this.#view.trigger.mode === "roll" ? "rolling" : words[sweep.cause] ?? "triggered");
    $("trigger-state").classList.toggle("lit", sweep.cause === "trigger");
    if (sweep.mode === "single" && sweep.complete) this.#armed = false; // one of the mode before may still be under way
    clearTimeout(this.#silence);
    this.#silence = setTimeout(() => this.#waits(), 600 + 2000 * this.#view.seconds);
    this.#later();
  }

  /** Nothing has come for longer than two screens. */
  #waits() {
    say($("trigger-state"), this.held ? "held" : this.#view.trigger.mode === "single" && !this.#armed ? "done" : "waiting");
    $("trigger-state").classList.remove("lit");
  }

  #span() {
    const { seconds, trigger } = this.#view;
    if (trigger.mode === "roll") return [-seconds, 0];
    const before = (seconds * trigger.pre_percent) / 100;
    return [-before, seconds - before];
  }

  #later() {
    if (this.#drawing) return;
    this.#drawing = true;
    requestAnimationFrame(() => {
      this.#drawing = false;
      this.#show();
    });
  }

  #show() {
    if (!this.sweep || !this.#lanes.lanes.length || $("scope").hidden) return;
    const older = this.#view.trigger.mode === "roll" || !this.#view.overlay ? [] : this.#older.slice(-this.#view.overlay);
    const sweeps = [
      ...(this.#reference ? [{ sweep: this.#reference, faded: 0.45 }] : []),
      ...older.map((sweep, place) => ({ sweep, faded: 0.1 + (0.35 * (place + 1)) / older.length })),
      { sweep: this.sweep, faded: 1 },
    ];
    this.#lanes.show(sweeps, this.#span(), this.#view.autoscale);
    this.#markers.place();
    this.#figures.show(this.sweep, this.#view.signals, this.#window());
  }

  #window() {
    return this.#markers.times ? [...this.#markers.times].sort((a, b) => a - b) : this.#span();
  }
}
