// The strip on top: state, mode and vitals, alarms as text, and the age of the shown values.

import { $, make, say } from "./dom.js";
import { counted, fixed } from "./numbers.js";

const words = (name) => String(name).replaceAll("_", " ");
/** With a capital letter and a full stop; "" without a text. */
const sentence = (text) => (text ? `${text[0].toUpperCase()}${text.slice(1)}.` : "");
const STATUS_MS = 1000;
const STOPPED = ["stopped", "armed"];
/** In these a STOP is done, whoever asked for it. */

const NO_CONNECTION = "No connection: the values shown are old, and STOP may not get through. Use the emergency stop.";
const NO_SERVICE = "STOP does not get through, and the values shown are old. A loop that still runs parks its outputs. If the outputs must be safe now, use the emergency stop.";

/** The one found first with its numbers, then the others. */
function causes(trip, reason) {
  const others = trip.filter((cause) => !reason?.includes(cause));
  const also = others.length && reason ? `also ${others.join(", ")}` : others.join(", ");
  return [reason, also].filter(Boolean).map(words).join("; ");
}

/** What comes after a trip: a recovery that is under way, or Reset. */
function remedy(recovery) {
  if (recovery?.state === "waiting") return "The service will confirm the readings and return; Stop prevents it.";
  if (recovery?.state === "confirming") return `The service confirms the readings (${recovery.confirmed} of ${recovery.confirmations}) and returns; Stop prevents it.`;
  return recovery?.state === "latched" && recovery.reason ? `No return, because ${recovery.reason}. Use Reset to continue.` : "Use Reset to continue.";
}

/** Axes that run in closed loop and are not controlled, and why; "" where all are. */
function uncontrolled(condition = {}) {
  return Object.entries(condition)
    .filter(([, found]) => found !== "controlled")
    .map(([axis, found]) => `${axis} ${found}`)
    .join(", ");
}

export class Strip {
  #state = null;
  #word = "";
  #focused = null; // element of the desk that had the focus when the desk became inert

  constructor(live) {
    live.addEventListener("state", ({ detail }) => this.#take(detail));
    live.addEventListener("freshness", ({ detail }) => this.#fresh(detail));
  }

  /** Ask for the vitals every second from now on. */
  begin(get) {
    const ask = async () => {
      try {
        this.#status(await get("/api/status"));
      } catch {
        this.#status({});
      }
      setTimeout(ask, STATUS_MS);
    };
    ask();
  }

  get state() {
    return this.#state;
  }

  #take(state) {
    const before = this.#word;
    this.#state = state;
    const ill = state.state === "running" ? uncontrolled(state.condition) : "";
    this.#word = ill || words(state.state);
    $("state").dataset.state = ill ? "uncontrolled" : state.state;
    say($("state-word"), this.#word);
    say($("mode"), state.mode ? words(state.mode) : "");
    say($("tick"), counted(state.tick));
    if (before !== this.#word) say($("spoken"), `${this.#word}${state.mode ? `, mode ${words(state.mode)}` : ""}`);
    const why = state.trip?.length ? causes(state.trip, state.trip_reason) : (state.faults ?? []).join("; ");
    say($("alarm"), state.state === "tripped" && why ? `Tripped: ${why}. ${remedy(state.recovery)}` : "");
    if (STOPPED.includes(state.state)) say($("stop-alarm"), "");
    document.title = `${ill ? "!" : state.state === "running" ? "▶" : state.state === "tripped" ? "✕" : "■"} ${$("name").textContent} · rtloop`;
  }

  #status({ rate_hz, lateness_us, recording, periods_missed }) {
    say($("rate"), rate_hz ? `${fixed(rate_hz / 1000, 3)} kHz` : "—");
    say($("late"), lateness_us ? `${fixed(lateness_us.p99, 0)} µs${periods_missed ? `, ${periods_missed} missed` : ""}` : "—");
    const ill = recording?.state && recording.state !== "recording";
    $("recording").replaceChildren(ill ? make("span", { class: "error" }, `✕ ${recording.reason ?? recording.state}`) : recording?.state ? "● on" : "—");
  }

  #fresh({ connected, answered, fresh, age_s, silence_s }) {
    document.body.classList.toggle("stale", !fresh);
    this.#disableDesk(!answered);
    const old_s = age_s ?? (!connected && Number.isFinite(silence_s) ? silence_s : null);
    const age = old_s == null ? "none yet" : `${fixed(old_s, old_s < 10 ? 1 : 0)} s old`;
    say($("age"), fresh ? "live" : age);
    const why = connected ? (this.#state?.error ?? "no new ticks") : "no connection to the panel's server";
    const says = `${sentence(why).slice(0, -1)}${old_s == null ? "" : `; the values shown are ${age}`}`;
    for (const veil of document.querySelectorAll(".veil")) if (!fresh) veil.dataset.says = says;
    const spoken = fresh ? "" : !connected ? NO_CONNECTION : answered ? "No new ticks: the values shown are old." : [sentence(why), NO_SERVICE, sentence(this.#state?.remedy)].join(" ");
    say($("said"), this.note && fresh ? this.note : spoken);
  }

  /** Make the desk inert, or usable again without its old errors and with the focus where it was. */
  #disableDesk(disabled) {
    const desk = $("desk");
    if (disabled === desk.inert) return;
    const focused = document.activeElement;
    if (disabled) this.#focused = desk.contains(focused) ? (focused.closest(".picker")?.querySelector("button") ?? focused) : null;
    else for (const place of desk.querySelectorAll(".error")) place.replaceChildren();
    desk.inert = disabled;
    if (!disabled && document.activeElement === document.body) this.#focused?.focus({ preventScroll: true });
  }

  /** Tell something for a few seconds, in words that are read out. */
  tell(text, for_ms = 8000) {
    this.note = text;
    say($("said"), text);
    clearTimeout(this.timer);
    this.timer = setTimeout(() => {
      this.note = "";
      say($("said"), "");
    }, for_ms);
  }
}
