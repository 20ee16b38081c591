// Lines on a plot that are moved by pointer or keyboard: cursors in time and in value, the level of a trigger.

import { make } from "../dom.js";

/** A line at a value of a scale of a chart; `moved(value)` hears where it was put. */
export class Line {
  #element;
  #chart;
  #key;
  #moved;
  #name;

  constructor(chart, { key, name, text, kind = "", moved, reachable = true }) {
    Object.assign(this, { text });
    this.#chart = chart;
    this.#key = key;
    this.#name = name;
    this.#moved = moved;
    const upright = key === "x";
    const slider = reachable
      ? { role: "slider", tabindex: "0", "aria-label": name, "aria-orientation": upright ? "horizontal" : "vertical" }
      : { "aria-hidden": "true" };
    this.#element = make("div", { class: `cursor ${upright ? "upright" : "level"} ${kind}`, hidden: true, ...slider }, reachable ? make("b", {}, text) : null);
    this.#element.addEventListener("pointerdown", (event) => this.#grab(event));
    this.#element.addEventListener("keydown", (event) => this.#key_down(event));
    chart.over.append(this.#element);
  }

  /** Put it there; `says` is what a screen reader is told. */
  place(value, says) {
    this.value = value;
    const [low, high] = this.#chart.range(this.#key);
    const upright = this.#key === "x";
    const seen = Math.min(Math.max(value, low), high); // beyond the edge it waits there to be fetched back
    this.#element.style[upright ? "left" : "top"] = `${this.#chart.at(seen, this.#key, true)}px`;
    this.#element.hidden = false;
    this.#element.classList.toggle("beyond", seen !== value);
    if (!this.#element.hasAttribute("role")) return;
    this.#element.setAttribute("aria-valuemin", String(low));
    this.#element.setAttribute("aria-valuemax", String(high));
    this.#element.setAttribute("aria-valuenow", String(value));
    this.#element.setAttribute("aria-valuetext", `${this.#name}: ${says}`);
  }

  remove() {
    this.#element.remove();
  }

  #grab(event) {
    event.preventDefault();
    this.#element.focus();
    this.#element.setPointerCapture(event.pointerId);
    const move = (moved) => this.#put(this.#along(moved));
    this.#element.addEventListener("pointermove", move);
    this.#element.addEventListener("lostpointercapture", () => this.#element.removeEventListener("pointermove", move), { once: true });
  }

  #along(event) {
    const box = this.#chart.over.getBoundingClientRect();
    return this.#key === "x" ? event.clientX - box.left : event.clientY - box.top;
  }

  #key_down(event) {
    const steps = this.#key === "x" ? { ArrowLeft: -1, ArrowRight: 1 } : { ArrowUp: -1, ArrowDown: 1 };
    if (!(event.key in steps)) return;
    event.preventDefault();
    this.#put(this.#chart.at(this.value, this.#key, true) + steps[event.key] * (event.shiftKey ? 10 : 1));
  }

  #put(css_px) {
    const { clientWidth, clientHeight } = this.#chart.over;
    const most = this.#key === "x" ? clientWidth : clientHeight;
    this.#moved(this.#chart.value(Math.min(Math.max(css_px, 0), most), this.#key));
  }
}
