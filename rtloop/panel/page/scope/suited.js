// The trigger that suits the present reference, found from its ticks, whichever client set it.

import { get } from "../api.js";
import { $ } from "../dom.js";

const FIRST_WAIT_MS = 300; // after the reference was changed; later ones are longer, for a slow reference shows late how far it goes
const LONGEST_WAIT_MS = 5000;
const LONGEST_S = 20;
const HYSTERESIS = 0.1; // of the reference's stroke
const SAME = 0.02; // of it: levels that are closer are not set anew

/** Conditions of a trigger for a reference that lies between two values: any step where they are one, else their middle. */
export function suitedCondition(low, high) {
  if (low === high) return { kind: "step", threshold: 0 };
  const round = (value) => Number(value.toPrecision(6));
  return { kind: "edge", slope: "rising", level: round((low + high) / 2), hysteresis: round(HYSTERESIS * (high - low)) };
}

/** Whether a trigger has a condition already, as far as it matters. */
export function isSuited(trigger, condition) {
  if (trigger.source !== condition.source || trigger.kind !== condition.kind) return false;
  if (condition.kind === "step") return trigger.threshold === condition.threshold;
  const stroke = condition.hysteresis / HYSTERESIS;
  const near = (key) => Math.abs(trigger[key] - condition[key]) <= SAME * stroke;
  return trigger.slope === condition.slope && near("level") && near("hysteresis");
}

export class SuitedTrigger {
  #trigger;
  #panel;
  #view;
  #now = null;
  #since = 0;
  #wait_ms = FIRST_WAIT_MS;
  #timer = null;

  /** Has `trigger` follow the reference while `view.suited`. */
  constructor(live, panel, view, trigger) {
    this.#panel = panel;
    this.#view = view;
    this.#trigger = trigger;
    $("suited").addEventListener("click", () => this.#again(FIRST_WAIT_MS));
    live.addEventListener("state", ({ detail }) => this.#take(detail));
    live.addEventListener("events", ({ detail }) => {
      for (const { kind, tick, run } of detail.events) if (kind === "set_reference" && run === this.#now?.run) this.#changed(tick);
    });
  }

  /** Look at the reference soon, from a tick on. */
  #changed(tick) {
    this.#since = Math.max(this.#since, tick);
    this.#again(FIRST_WAIT_MS);
  }

  #again(wait_ms) {
    this.#wait_ms = wait_ms;
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#look(), wait_ms);
  }

  #take({ run, tick }) {
    if (tick == null || run == null) return;
    const another = run !== this.#now?.run;
    this.#now = { run, tick };
    if (another) this.#since = 0;
    if (another) this.#changed(0);
  }

  /** The first reference that is shown, else that of the first axis. */
  get #source() {
    const references = this.#panel.axes.map((axis) => `${axis}_reference_um`);
    return references.find((name) => this.#view.signals.includes(name)) ?? references[0];
  }

  async #look() {
    if (!this.#now) return;
    const { run, tick } = this.#now;
    const kept = Math.round(Math.min(LONGEST_S, this.#panel.longest_s) * this.#panel.rate_hz);
    const [first, source] = [Math.max(this.#since, tick - kept, 0), this.#source];
    if (this.#view.suited && this.#view.trigger.mode !== "roll" && first < tick) {
      try {
        const { low, high } = (await get(`/api/measure?run=${run}&first=${first}&end=${tick}&signals=${source}`))[source];
        if (run === this.#now.run && this.#since <= first) this.#trigger.suit({ source, ...suitedCondition(low, high) });
      } catch {
        // Its ticks are not kept; later ones will be.
      }
    }
    this.#again(Math.min(1.5 * this.#wait_ms, LONGEST_WAIT_MS));
  }
}
