// The controls of trigger and time base: their values are the scope's subscription.

import { $, complain } from "../dom.js";
import { duration, fromField, significant } from "../numbers.js";
import { Picker } from "../picker.js";
import { isSuited } from "./suited.js";

const KINDS = [
  { value: "edge", text: "edge" }, { value: "window", text: "window left" }, { value: "step", text: "step" },
  { value: "trip", text: "trip" }, { value: "mode", text: "mode change" }, { value: "command", text: "command" },
  { value: "late", text: "late tick" },
];
const SLOPES = ["rising", "falling", "either"].map((value) => ({ value, text: value }));
const NUMBERS = { level: "level", hysteresis: "hysteresis", low: "low", high: "high", threshold: "threshold", holdoff: "holdoff_s", pre: "pre_percent" };
const SUITED = ["kind", "source", "slope", "level", "hysteresis", "low", "high", "threshold"];
const TIMES_S = [];
for (let power = -3; power <= 1; power++) for (const step of [1, 2, 5]) TIMES_S.push(Number(`${step}e${power}`));
TIMES_S.push(60);

export class Trigger {
  #settings;
  #changed;
  #pickers;

  /** `settings` are {seconds, trigger}, changed in place; `changed` is called after each change. */
  constructor(settings, columns, longest_s, changed) {
    this.#settings = settings;
    this.#changed = changed;
    const pick = (id, key, options) => {
      const picker = new Picker($(id), (value) => this.#set(key, value));
      picker.options = options;
      picker.value = settings.trigger[key];
      return picker;
    };
    this.#pickers = {
      kind: pick("trigger-kind", "kind", KINDS),
      source: pick("trigger-source", "source", columns.map(({ name }) => ({ value: name, text: name }))),
      slope: pick("trigger-slope", "slope", SLOPES),
    };
    const times = TIMES_S.filter((time_s) => time_s <= Math.max(longest_s ?? 60, 1));
    this.times = times;
    this.seconds = new Picker($("seconds"), (value) => this.setSeconds(value));
    this.seconds.options = times.map((value) => ({ value, text: duration(value, 2) }));
    this.seconds.value = settings.seconds;
    $("shorter").addEventListener("click", () => this.turn(-1));
    $("longer").addEventListener("click", () => this.turn(1));
    for (const [id, key] of Object.entries(NUMBERS)) $(id).addEventListener("change", () => this.#read(id, key));
    $("suited").addEventListener("click", () => {
      this.#settings.suited = !this.#settings.suited;
      this.#show();
      this.#changed();
    });
    this.#fill();
    for (const form of [$("trigger"), $("condition")]) {
      form.addEventListener("submit", (event) => {
        event.preventDefault();
        document.activeElement?.dispatchEvent(new Event("change"));
      });
    }
    for (const button of $("trigger-mode").querySelectorAll("button")) {
      button.addEventListener("click", () => this.#set("mode", button.value));
    }
    this.#show();
  }

  /** Take over the condition that suits the reference; what was set by hand stays. */
  suit(condition) {
    if (!this.#settings.suited || isSuited(this.#settings.trigger, condition)) return;
    Object.assign(this.#settings.trigger, condition);
    for (const [key, picker] of Object.entries(this.#pickers)) picker.value = this.#settings.trigger[key];
    this.#fill();
    this.#show();
    this.#changed();
  }

  #fill() {
    for (const [id, key] of Object.entries(NUMBERS)) {
      const text = significant(this.#settings.trigger[key], 6).replace("−", "-");
      $(id).value = text.includes(".") && !text.includes("e") ? text.replace(/\.?0+$/, "") : text;
    }
  }

  /** More or less time a screen. */
  turn(places) {
    const at = this.times.findIndex((time_s) => time_s >= this.#settings.seconds);
    this.setSeconds(this.times[Math.min(Math.max(at + places, 0), this.times.length - 1)]);
  }

  setSeconds(seconds) {
    this.#settings.seconds = seconds;
    this.seconds.value = seconds;
    this.#changed();
  }

  /** A level that was moved on the plot. */
  setLevel(level) {
    $("level").value = String(Number(level.toPrecision(4)));
    this.#set("level", Number(level.toPrecision(4)));
  }

  #read(id, key) {
    try {
      this.#set(key, fromField($(id)));
      complain($("trigger-error"), null);
    } catch (error) {
      complain($("trigger-error"), error);
    }
  }

  #set(key, value) {
    this.#settings.trigger[key] = value;
    if (SUITED.includes(key)) this.#settings.suited = false;
    this.#show();
    this.#changed();
  }

  #show() {
    const { mode, kind } = this.#settings.trigger;
    for (const button of $("trigger-mode").querySelectorAll("button")) {
      button.setAttribute("aria-pressed", String(button.value === mode));
    }
    $("suited").setAttribute("aria-pressed", String(this.#settings.suited));
    $("condition").hidden = mode === "roll";
    $("force").hidden = mode === "roll" || mode === "auto";
    $("arm-single").hidden = mode !== "single";
    for (const field of $("condition").querySelectorAll("[data-for]")) {
      field.hidden = !field.dataset.for.split(" ").includes(kind);
    }
  }
}
