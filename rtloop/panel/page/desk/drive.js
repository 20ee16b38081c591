// Arm, start, stop, reset, the mode, and the lock holder.

import { command, releaseLock, stop, who } from "../api.js";
import { $, complain, say } from "../dom.js";
import { HoldButton } from "../hold.js";
import { Picker } from "../picker.js";

const NEXT = { stopped: ["Arm", "arm"], armed: ["Start", "start"] };
const MODES = ["closed_loop", "feedforward", "raw", "off"];

export class Drive {
  #strip;
  #mode;
  #next = null;
  #refusals = new Map(); // text of the last refusal in each place

  constructor(live, strip) {
    this.#strip = strip;
    this.go = new HoldButton($("go"), () => this.#next && this.driving(this.#next, {}, $("power-error")));
    this.#mode = new Picker($("set-mode"), (mode) => this.driving("mode", { mode }, $("power-error")));
    this.#mode.options = MODES.map((value) => ({ value, text: value.replace("_", " ") }));
    $("stop").addEventListener("click", () => this.stop());
    $("reset").addEventListener("click", () => this.driving("reset", {}, $("power-error")));
    $("who").value = who.name;
    $("who").addEventListener("input", () => (who.name = $("who").value));
    $("lock").addEventListener("submit", (event) => {
      event.preventDefault();
      this.driving("lock", {}, $("lock-error"));
    });
    $("release").addEventListener("click", () => this.#release());
    $("break").addEventListener("click", () => {
      $("key-row").hidden = !$("key-row").hidden;
      $("break").setAttribute("aria-expanded", String(!$("key-row").hidden));
      if (!$("key-row").hidden) $("key").focus();
    });
    $("key-row").addEventListener("submit", async (event) => {
      event.preventDefault();
      const key = $("key").value;
      $("key").value = "";
      if (await this.driving("lock", { emergency_key: key }, $("lock-error"))) $("key-row").hidden = true;
    });
    live.addEventListener("state", ({ detail }) => this.#show(detail));
  }

  /** Send a command under the name of who drives; its answer, or null with the refusal shown in `place`; `options` of fetch. */
  async driving(name, body, place, options) {
    who.name = $("who").value;
    if (!who.name) {
      complain($("lock-error"), "Enter your name: commands are recorded with the name of the client that drives.");
      $("who").focus();
      return null;
    }
    try {
      const answer = await command(name, body, options);
      complain(place, null);
      complain($("lock-error"), null);
      return answer;
    } catch (error) {
      complain(place, error);
      this.#refusals.set(place, error.message);
      return null;
    }
  }

  /** Clear the refusals that are still shown: nobody else holds the lock any more. */
  #withdrawRefusals() {
    for (const [place, text] of this.#refusals) if (place.textContent === text) complain(place, null);
    this.#refusals.clear();
  }

  async stop() {
    this.go.end();
    this.#strip.tell("STOP is being sent…", 2000);
    try {
      const { tick } = await stop((error) => say($("stop-alarm"), `STOP did not get through: ${error.message}. Use the emergency stop!`));
      say($("stop-alarm"), "");
      this.#strip.tell(`Stopped${tick == null ? "" : ` at tick ${tick}`}: the outputs ramp to their safe values.`);
    } catch (error) {
      if (error.status === 409) this.#strip.tell(error.message);
      else say($("stop-alarm"), `STOP did not get through: ${error.message}. Use the emergency stop!`);
    }
  }

  async #release() {
    try {
      await releaseLock();
      complain($("lock-error"), null);
    } catch (error) {
      complain($("lock-error"), error);
    }
  }

  #show({ state, mode, lock, unix_s }) {
    const [word, next] = NEXT[state] ?? [state === "running" ? "Running" : "Start", null];
    if (next !== this.#next) this.go.end(); // armed by somebody else meanwhile: who holds "Arm" does not start
    this.#next = next;
    $("go").disabled = !next;
    say($("go-word"), word);
    $("reset").disabled = state !== "tripped";
    if (mode) this.#mode.value = mode;
    this.#mode.disabled = !["armed", "running"].includes(state);
    const by = !lock ? "nobody" : lock.name === who.name ? "me" : "other";
    if (by !== "other" && $("drives").dataset.by === "other") this.#withdrawRefusals();
    $("drives").dataset.by = by;
    if (state === "unreachable") return say($("drives"), "—");
    if (!lock) return say($("drives"), "Nobody drives. The first command takes the lock; stop works for everybody.");
    const left_s = Math.max(0, Math.round(lock.until_unix_s - unix_s));
    const mine = lock.name === who.name;
    say($("drives"), `${mine ? "You drive" : `${lock.name} drives`}; the lock is free ${left_s > 0 ? `after ${left_s} s without a command` : "now"}.`);
  }
}
