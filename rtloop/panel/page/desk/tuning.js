// Tuning: a change of controller or model is applied only after its margins, step and tolerated shift were shown.

import { command } from "../api.js";
import { $, calmly, complain, make, say } from "../dom.js";
import { counted, fromField } from "../numbers.js";
import { Picker } from "../picker.js";
import { Preview } from "./preview.js";

const SECTIONS = ["controller", "model", "prefilter", "limits", "interlocks"];
const SLIDER_SPAN = 0.5;
/** Of the value in force, up and down; the field takes any. */

export class Tuning {
  #drive;
  #axis;
  #section;
  #key;
  #configuration;
  #asked = 0;
  #shown = null;
  #preview = new Preview();

  /** `axis()` is the axis of the desk. */
  constructor(drive, configuration, axis) {
    this.#drive = drive;
    this.#configuration = configuration;
    this.#axis = axis;
    this.#section = new Picker($("tune-section"), () => this.#arrange());
    this.#section.options = SECTIONS.map((value) => ({ value, text: value }));
    this.#key = new Picker($("tune-key"), () => this.#start());
    $("tune-slider").addEventListener("input", () => {
      $("tune-value").value = $("tune-slider").value;
      this.#previewSoon();
    });
    $("tune-value").addEventListener("input", () => {
      this.#withdraw();
      $("tune-slider").value = $("tune-value").value.replace(",", ".");
    });
    $("tune").addEventListener("submit", (event) => {
      event.preventDefault();
      this.#ask(() => ({ [this.#key.value]: fromField($("tune-value")) }));
    });
    $("tune-many").addEventListener("submit", (event) => {
      event.preventDefault();
      this.#ask(() => changed(fromJson($("tune-json").value), this.#values));
    });
    configuration.addEventListener("read", () => this.#arrange());
    $("apply").addEventListener("click", () => this.#apply());
    $("discard").addEventListener("click", () => this.#start());
    $("undo").addEventListener("click", () => this.undo());
  }

  /** Read the configuration as it runs, and begin anew from it. */
  async read() {
    try {
      await this.#configuration.read();
      complain($("tune-error"), null);
    } catch (error) {
      complain($("tune-error"), error);
    }
  }

  /** Lay out the preview's plot anew, as after a change of the theme. */
  arrange() {
    this.#preview.arrange();
  }

  async undo() {
    const answer = await this.#drive.driving("undo", { axis: this.#axis() }, $("tune-error"));
    if (!answer) return;
    say($("tune-done"), `undone at tick ${counted(answer.tick)}${answer.undone ? `: ${answer.undone}` : ""}`);
    await this.read();
  }

  /** Of the section that is chosen. */
  get #values() {
    return this.#configuration.section(this.#axis(), this.#section.value);
  }

  #numbersOf() {
    return Object.entries(this.#values).filter(([, value]) => typeof value === "number");
  }

  #arrange() {
    const keys = this.#numbersOf();
    const lists = !keys.length && Object.keys(this.#values).length > 0;
    this.#key.options = keys.length ? keys.map(([value]) => ({ value, text: value })) : [{ value: "", text: lists ? "lists only: see below" : "no keys are configured" }];
    if (lists) $("tune-json").closest("details").open = true;
    this.#start();
  }

  #start() {
    const value = Object.fromEntries(this.#numbersOf())[this.#key.value];
    const none = value === undefined;
    $("tune-value").disabled = $("tune-slider").disabled = $("show-preview").disabled = none;
    $("tune-value").value = none ? "" : String(value);
    say($("tune-now"), none ? "" : `now ${Number(value.toPrecision(6))}`);
    const span = Math.abs(value || 1) * SLIDER_SPAN;
    const step = 10 ** Math.floor(Math.log10(span / 100));
    Object.assign($("tune-slider"), { step: String(Number(step.toPrecision(1))), min: String(Number(((value || 0) - span).toPrecision(6))), max: String(Number(((value || 0) + span).toPrecision(6))) });
    $("tune-slider").value = String(value ?? 0);
    $("tune-json").value = asJson(this.#values);
    this.#withdraw();
  }

  /** What was shown, or refused, is no longer what would be applied. */
  #withdraw() {
    this.#asked += 1;
    this.#shown = null;
    $("preview").hidden = true;
    complain($("tune-error"), null);
  }

  #previewSoon = calmly(250, () => this.#ask(() => ({ [this.#key.value]: fromField($("tune-value")) })));

  async #ask(read) {
    this.#withdraw();
    const number = this.#asked;
    try {
      const wanted = { axis: this.#axis(), section: this.#section.value, values: read() };
      if (!Object.keys(wanted.values).length) throw new Error("keys: no key is changed; change at least one");
      $("tune").setAttribute("aria-busy", "true");
      const { before, after } = await command("preview", wanted);
      if (number !== this.#asked) return;
      complain($("tune-error"), null);
      this.#shown = wanted;
      $("preview").hidden = false;
      this.#preview.show(before, after);
      $("apply").textContent = `Apply ${Object.entries(wanted.values).map(([key, value]) => (typeof value === "number" ? `${key} = ${value}` : key)).join(", ")}`;
      $("preview").scrollIntoView({ block: "nearest" });
    } catch (error) {
      if (number === this.#asked) complain($("tune-error"), error);
    } finally {
      $("tune").removeAttribute("aria-busy");
    }
  }

  async #apply() {
    if (!this.#shown) return;
    const wanted = this.#shown;
    $("apply").disabled = true;
    const answer = await this.#drive.driving("tune", wanted, $("tune-error"));
    $("apply").disabled = false;
    if (!answer) return;
    say($("tune-done"), `applied at tick ${counted(answer.tick)}`);
    this.#withdraw();
    $("undo").focus();
    await this.read();
  }
}

/** A key to a line, lists as they are. */
function asJson(values) {
  const lines = Object.entries(values).map(([key, value]) => `  ${JSON.stringify(key)}: ${JSON.stringify(value)}`);
  return lines.length ? `{\n${lines.join(",\n")}\n}` : "{}";
}

/** Those of `wanted` that are otherwise now. */
function changed(wanted, now) {
  return Object.fromEntries(Object.entries(wanted).filter(([key, value]) => JSON.stringify(value) !== JSON.stringify(now[key])));
}

function fromJson(text) {
  try {
    const values = JSON.parse(text);
    if (values && typeof values === "object" && !Array.isArray(values)) return values;
  } catch {
    // Shown below.
  }
  throw new Error('keys: not a JSON object; allowed: an object such as {"gain": 0.012, "method": "tustin"}');
}
