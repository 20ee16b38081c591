// The scope: what is asked of the server, the sweeps that came, and how they are shown.

import { get } from "../api.js";
import { $, calmly, complain, make, say } from "../dom.js";
import { counted, duration, fromField, significant } from "../numbers.js";
import { DASHES, palette } from "../palette.js";
import { Picker } from "../picker.js";
import { Lanes } from "./lanes.js";
import { Markers } from "./markers.js";
import { remember, remembered } from "./settings.js";
import { isDecimated, Table } from "./table.js";
import { Trigger } from "./trigger.js";

const MOST_TRACES = 8;
const OVERLAYS = [0, 1, 3, 7, 15, 31];
export class Scope {
  #live;
  #panel;
  #view;
  #lanes = new Lanes($("scope-plot"));
  #table = new Table();
  #older = [];
  #reference = null;
  #exact = null;
  #drawing = false;
  #markers;
  #add;
  #overlays;
  sweep = null;
  held = false;

  constructor(live, panel) {
    this.#live = live;
    this.#panel = panel;
    this.#view = remembered(panel);
    this.trigger = new Trigger(this.#view, panel.columns, panel.longest_s, () => this.#asked());
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
      this.#lanes.limits.clear();
      this.arrange();
    });
    $("cursors").addEventListener("click", () => this.#markers.toggle());
    $("hold").addEventListener("click", () => this.toggleHold());
    $("force").addEventListener("click", () => live.once({ force: true }));
    $("arm-single").addEventListener("click", () => live.once({ arm: true }));
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

  /** Draw what came last, as after it was out of sight. */
  redraw() {
    this.#later();
  }

  toggleHold() {
    this.held = !this.held;
    $("hold").setAttribute("aria-pressed", String(this.held));
    this.#live.wish({ hold: this.held });
    this.#measureSoon();
  }

  /** Lay out plots and tables anew, as after a change of the theme. */
  arrange() {
    const units = Object.fromEntries(this.#panel.columns.map(({ name, unit }) => [name, unit]));
    this.traces = this.#view.signals.map((name, place) => ({ name, unit: units[name], colour: palette().traces[place], dash: DASHES[place] }));
    this.#lanes.arrange(this.traces, this.#view.stacked);
    $("stacked").setAttribute("aria-pressed", String(this.#view.stacked));
    $("autoscale").setAttribute("aria-pressed", String(this.#view.autoscale));
    this.#table.arrange(this.traces, (gone) => this.#traces(this.#view.signals.filter((name) => name !== gone)));
    const free = this.#panel.columns.filter(({ name }) => !this.#view.signals.includes(name));
    this.#add.options = [{ value: "", text: "a trace…" }, ...free.map(({ name, unit }) => ({ value: name, text: unit === "1" ? name : `${name}, ${unit}` }))];
    this.#add.value = "";
    this.#add.disabled = this.#view.signals.length >= MOST_TRACES;
    this.#arrangeScales();
    this.#markers.arrange(this.#view, this.#span());
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
    this.#waiting();
    this.#later();
  }

  /** Nothing has come for longer than two screens: a trigger is waited for. */
  #waiting = calmly(0, () => {
    clearTimeout(this.waitingTimer);
    this.waitingTimer = setTimeout(() => {
      say($("trigger-state"), this.held ? "held" : this.#view.trigger.mode === "single" ? "done" : "waiting");
      $("trigger-state").classList.remove("lit");
    }, 600 + 2000 * this.#view.seconds);
  });

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
    this.#number();
  }

  #number = calmly(200, () => {
    const window = this.#window();
    this.#table.show(this.sweep, window, this.#exact?.of === this.#stretch() ? this.#exact.figures : null);
    const { trigger, uncertain_ticks, rate_hz, number } = this.sweep;
    say($("sweep-says"), `${number ? `sweep ${counted(number)} ` : ""}at tick ${counted(trigger)}${uncertain_ticks ? `, or up to ${uncertain_ticks} before` : ""}; ${duration(this.#perPoint() / rate_hz, 3)} a point`);
    this.#measureSoon();
  });

  #perPoint() {
    const { offset } = this.sweep.arrays;
    return offset.length > 1 ? (offset[offset.length - 1] - offset[0]) / (offset.length - 1) : 1;
  }

  #window() {
    return this.#markers.times ? [...this.#markers.times].sort((a, b) => a - b) : this.#span();
  }

  #stretch() {
    const [from_s, to_s] = this.#window();
    const { run, trigger, rate_hz, first, end } = this.sweep;
    const tick = (time_s) => Math.min(Math.max(trigger + Math.round(time_s * rate_hz), first, 0), end);
    return `run=${run}&first=${tick(from_s)}&end=${Math.max(tick(to_s) + 1, tick(from_s) + 1)}&signals=${this.#view.signals}`;
  }

  /** Figures of all ticks come from the server: an envelope tells rms and σ only about. */
  #measureSoon = calmly(400, async () => {
    if (!this.sweep || !isDecimated(this.sweep) || this.#exact?.none) return;
    const of = this.#stretch();
    if (of === this.#exact?.of) return;
    try {
      this.#exact = { of, figures: await get(`/api/measure?${of}`) };
      if (of === this.#stretch()) this.#table.show(this.sweep, this.#window(), this.#exact.figures);
    } catch (error) {
      this.#exact = error.status === 404 ? { none: true } : null;
    }
  });

  #arrangeScales() {
    const fields = this.#view.autoscale ? [] : this.#lanes.lanes.flatMap((lane) => lane.units.map((unit) => this.#scaleField(lane, unit)));
    $("scales").replaceChildren(...fields);
  }

  #scaleField(lane, unit) {
    const id = `${lane.id}/${unit}`;
    const name = lane.id === "all" ? unit : lane.id;
    const [low, high] = this.#lanes.limits.get(id) ?? [-1, 1];
    const fields = [low, high].map((value, place) => make("input", { value: significant(value, 4).replace("−", "-"), size: 6, "aria-label": `${name}: ${place ? "highest" : "lowest"}` }));
    const read = () => {
      try {
        const [lowest, highest] = fields.map(fromField);
        if (lowest >= highest) throw new Error(`${name}: from ${lowest} to ${highest}; the lower end comes first`);
        this.#lanes.setLimits(id, lowest, highest);
        complain($("trigger-error"), null);
        this.#later();
      } catch (error) {
        complain($("trigger-error"), error);
      }
    };
    for (const field of fields) field.addEventListener("change", read);
    return make("span", { class: "field" }, make("span", {}, name), fields[0], "…", fields[1]);
  }
}
