// The reference of an axis: a setpoint, a jog, a generator, a waveform from a file.

import { $, complain, make, say } from "../dom.js";
import { DECIMALS, fixed, fromField, parseNumber, significant } from "../numbers.js";
import { Picker } from "../picker.js";
import { jogSteps } from "./steps.js";

const KINDS = {
  sine: { amplitude: ["amplitude, UNIT", "5"], frequency_hz: ["frequency, Hz", "1"], offset: ["offset, UNIT", "0"], phase_deg: ["phase, °", "0"] },
  triangle: { amplitude: ["amplitude, UNIT", "5"], frequency_hz: ["frequency, Hz", "1"], offset: ["offset, UNIT", "0"], phase_deg: ["phase, °", "0"] },
  steps: { levels: ["levels, UNIT (blanks or ; between)", "10; 0; -10; 0"], dwell_s: ["each held, s", "0.2"] },
  chirp: { amplitude: ["amplitude, UNIT", "1"], start_hz: ["from, Hz", "1"], end_hz: ["to, Hz", "100"], duration_s: ["within, s", "10"], offset: ["offset, UNIT", "0"] },
};
const UP = { ArrowUp: 1, ArrowRight: 1, ArrowDown: -1, ArrowLeft: -1 };
const LEAPS = ["PageUp", "PageDown", "Home", "End"];

/** Numbers with blanks, semicolons or lines between them. */
const numbers = (text, what) => text.split(/[\s;]+/).filter(Boolean).map((part) => parseNumber(part.replace(/,$/, ""), what));

/** One or two columns: {samples, command_um}; commas part columns where points are decimal. */
export function columns(text) {
  const lines = text.split(/\r?\n/).map((line) => line.replace(/#.*/, "").trim()).filter(Boolean);
  const rows = lines.map((line, number) => {
    const parts = line.split(/[;\t ]+/).length > 1 || !line.includes(".") ? line.split(/[;\t ]+/) : line.split(/[,\s]+/);
    if (parts.length > 2) throw new Error(`line ${number + 1}: ${parts.length} columns; allowed: one or two`);
    return parts.map((part) => parseNumber(part.replace(/,$/, ""), `line ${number + 1}`));
  });
  if (!rows.length) throw new Error("the file has no numbers; allowed: one number a line, or two");
  if (rows.some((row) => row.length !== rows[0].length)) throw new Error("the file has lines with one and with two columns; allowed: one in every line, or two in every line");
  return { samples: rows.map((row) => row[0]), command_um: rows[0].length === 2 ? rows.map((row) => row[1]) : [] };
}

export class Reference {
  #configuration;
  #drive;
  #axis;
  #kind;
  #jog;
  #fields = {};
  #arranged = ""; // kind and unit that the fields are for
  #typed = {};
  #unit = "µm";
  #now = {};
  #references = {}; // by axis: {kind, text, value}
  #isTyped = false; // a value that is not applied yet
  #shown = null; // text of the reference that the field followed last
  #tick = -1;
  #asked = {};
  #mode = null;

  constructor(live, panel, configuration, drive, changed) {
    this.#configuration = configuration;
    this.#drive = drive;
    this.#axis = new Picker($("desk-axis"), () => {
      this.#limit();
      this.#start();
      changed();
    });
    this.#axis.options = panel.axes.map((value) => ({ value, text: `axis ${value}` }));
    $("desk-axis").hidden = panel.axes.length < 2;
    this.#jog = new Picker($("jog-step"));
    this.#kind = new Picker($("generator-kind"), () => {
      this.#typed = {};
      this.#arrange();
    });
    this.#kind.options = Object.keys(KINDS).map((value) => ({ value, text: value }));
    this.#limit();
    $("setpoint").addEventListener("input", () => (this.#isTyped = true));
    $("setpoint").addEventListener("keydown", ({ key }) => key === "Escape" && this.#start());
    $("setpoint-slider").addEventListener("input", () => this.#stage(Number($("setpoint-slider").value)));
    $("setpoint-slider").addEventListener("keydown", (event) => this.#slide(event));
    const submitted = (id, action, place) => $(id).addEventListener("submit", (event) => {
      event.preventDefault();
      this.#try(action, $(place));
    });
    configuration.addEventListener("read", () => this.#limit());
    submitted("setpoint-form", () => this.set(fromField($("setpoint"))), "setpoint-error");
    submitted("generator", () => this.#play(), "generator-error");
    submitted("waveform", () => this.#upload(), "waveform-error");
    for (const button of document.querySelectorAll("[data-jog]")) button.addEventListener("click", () => this.jog(Number(button.dataset.jog)));
    live.addEventListener("state", ({ detail }) => {
      const first = !Number.isFinite(this.#now[this.axis]?.reference_um) && detail.axes;
      this.#now = detail.axes ?? this.#now;
      if (first) this.#start();
      this.#tick = detail.tick ?? -1;
      this.#references = detail.references ?? {};
      if (detail.mode !== this.#mode) {
        this.#mode = detail.mode;
        this.#limit();
      }
      this.#follow();
    });
  }

  get axis() {
    return this.#axis.value;
  }

  /** Show what the axis is at: what was typed for another one is not to be sent to this one. */
  #start() {
    $("setpoint").value = $("setpoint-slider").value = (this.#now[this.axis]?.reference_um ?? 0).toFixed(this.#decimals);
    say($("setpoint-staged"), "");
    complain($("setpoint-error"), null);
    this.#isTyped = false;
    this.#shown = null;
    this.#follow();
  }

  /** Say what the axis plays; the field has the value of a constant reference, none of another, and what is typed stays. */
  #follow() {
    const { kind, text, value } = this.#references[this.axis] ?? {};
    const isConstant = kind === "hold";
    const held = isConstant ? value ?? this.#now[this.axis]?.reference_um : null;
    say($("reference-now"), !kind ? "" : `Now: ${text || (isConstant ? `${fixed(held, this.#decimals)} ${this.#unit}` : kind)}`);
    for (const button of document.querySelectorAll("#generator [type=submit], #waveform [type=submit]")) say(button, kind && !isConstant ? "Replace" : "Play");
    const shown = held?.toFixed(this.#decimals) ?? "";
    if (!kind || this.#isTyped || shown === this.#shown) return;
    this.#shown = $("setpoint").value = shown;
    if (shown) $("setpoint-slider").value = shown;
  }

  get #decimals() {
    return DECIMALS[this.#unit];
  }

  /** Show a setpoint that Enter, or Set, is to apply. */
  #stage(value) {
    this.#isTyped = true;
    $("setpoint").value = $("setpoint-slider").value = value.toFixed(this.#decimals);
    say($("setpoint-staged"), `${fixed(value, this.#decimals)} ${this.#unit} is not applied yet: Enter or Set applies it.`);
  }

  /** Keys on the slider: an arrow moves it by one step of the jog, Enter applies, and no key crosses the stroke. */
  #slide(event) {
    const { key } = event;
    const slider = $("setpoint-slider");
    if (key === "Enter" && !event.repeat) $("setpoint-form").requestSubmit();
    else if (key in UP) this.#stage(Math.min(Math.max(Number(slider.value) + UP[key] * this.#jog.value, Number(slider.min)), Number(slider.max)));
    else if (!LEAPS.includes(key)) return;
    event.preventDefault();
  }

  /** Hold a value, in µm, in V in raw mode. */
  async set(value) {
    $("setpoint").value = String(value);
    $("setpoint-slider").value = String(value);
    say($("setpoint-staged"), "");
    this.#isTyped = false;
    const asked = (this.#asked = { axis: this.axis, value, tick: Infinity });
    asked.tick = (await this.#drive.driving("setpoint", { axis: this.axis, value }, $("setpoint-error")))?.tick ?? -1;
  }

  /** From the reference as it is now, or was last asked for and is not seen yet, by the chosen distance. */
  jog(sign) {
    const { axis, value, tick } = this.#asked;
    const from = axis === this.axis && tick > this.#tick ? value : this.#now[this.axis]?.reference_um;
    if (!Number.isFinite(from)) return complain($("setpoint-error"), "jog: no reference is known yet; set a setpoint first");
    return this.set(Number((from + sign * this.#jog.value).toFixed(9)));
  }

  async #try(action, place) {
    try {
      await action();
    } catch (error) {
      complain(place, error);
    }
  }

  #limit() {
    const { most_um, lowest_v, highest_v, stroke_um } = this.#configuration.limits(this.axis);
    const raw = this.#mode === "raw";
    this.#unit = raw ? "V" : "µm";
    Object.assign($("setpoint-slider"), { min: raw ? lowest_v : -most_um, max: raw ? highest_v : most_um, step: 10 ** -this.#decimals });
    $("setpoint-form").querySelector(".unit").textContent = this.#unit;
    const { sizes, first } = jogSteps(raw ? highest_v - lowest_v : stroke_um);
    const before = this.#jog.value;
    this.#jog.options = sizes.map((value) => ({ value, text: `${significant(value, 1)} ${this.#unit}` }));
    this.#jog.value = sizes.includes(before) ? before : first;
    this.#arrange();
  }

  #arrange() {
    const arranged = `${this.#kind.value} ${this.#unit}`;
    if (arranged === this.#arranged) return; // a field that has the focus stays
    this.#arranged = arranged;
    this.#fields = {};
    const shown = Object.entries(KINDS[this.#kind.value]).map(([key, [label, value]]) => {
      const name = label.replace("UNIT", this.#unit);
      this.#fields[key] = make("input", { value: this.#typed[key] ?? value, input: ({ target }) => (this.#typed[key] = target.value) });
      return make("label", { class: "field", "data-name": name }, name, this.#fields[key]);
    });
    $("generator-fields").replaceChildren(...shown);
  }

  async #play() {
    const reference = { kind: this.#kind.value };
    for (const [key, field] of Object.entries(this.#fields)) reference[key] = key === "levels" ? numbers(field.value, key) : fromField(field);
    await this.#drive.driving("reference", { axis: this.axis, reference }, $("generator-error"));
  }

  async #upload() {
    const [file] = $("waveform-file").files;
    if (!file) throw new Error("waveform: no file; choose a file with one sample a line");
    const body = { axis: this.axis, ...columns(await file.text()), hold_ticks: fromField($("waveform-hold")), repeat: $("waveform-repeat").checked };
    const answer = await this.#drive.driving("waveform", body, $("waveform-error"));
    if (answer) complain($("setpoint-error"), null);
    if (answer) $("waveform-file").title = `${file.name}: ${fixed(body.samples.length, 0)} samples from tick ${answer.tick} on`;
  }
}
