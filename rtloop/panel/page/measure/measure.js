// Measurements of the running loop: response, resonance, new taps, a learned scan. The service makes them; here they
// are started, watched, cancelled, shown and accepted.

import { $, complain, say } from "../dom.js";
import { columns } from "../desk/reference.js";
import { fixed, fromField, significant } from "../numbers.js";
import { Picker } from "../picker.js";
import { Curves } from "./curves.js";
import { showLearned, showMargins, showRetuned } from "./tables.js";

/** Each activity: its name, the resource that does it, and its explanation. */
const ACTIVITIES = {
  response: ["Response", "response", "Measures L and S. A multisine moves the position around the setpoint, by no more than the amplitude."],
  resonance: ["Resonance", "response", "Measures only the lightly damped mode. A multisine around the frequency of the mode moves the position, by no more than the amplitude."],
  retune: ["Retune", "retune", "Measures the resonance and computes new taps for it. Nothing changes before you agree."],
  learn: ["Learn", "learn", "Plays one period of a scan from a file with one number (µm) for each tick, one a line. Corrects the scan from cycle to cycle. The learned scan plays on only if you agree."],
};
const PROPOSALS = ["retuned", "learned"];

export class Measure {
  #drive;
  #configuration;
  #tuned;
  #axis;
  #activity;
  #curves = new Curves();
  #axes = {};
  #references = {}; // by axis: {kind, text, value}
  #progress = null;
  #begun_ms = 0;
  #under_way = null; // AbortController of the request
  #proposal = null; // {name, body, done} of the command that an agreement sends

  /** `tuned` is called after taps were swapped in. */
  constructor(live, panel, configuration, drive, tuned) {
    this.#drive = drive;
    this.#configuration = configuration;
    this.#tuned = tuned;
    this.#axis = new Picker($("measure-axis"), () => {
      this.#arrange();
      this.#show();
    });
    this.#axis.options = panel.axes.map((value) => ({ value, text: value }));
    this.#activity = new Picker($("measure-activity"), () => this.#arrange());
    this.#activity.options = Object.entries(ACTIVITIES).map(([value, [text]]) => ({ value, text }));
    $("measure-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.#start();
    });
    $("measure-cancel").addEventListener("click", () => this.#under_way?.abort());
    $("measure-agree").addEventListener("click", () => this.#agree());
    $("measure-decline").addEventListener("click", () => this.#withdraw("Nothing was changed."));
    configuration.addEventListener("read", () => this.#arrange());
    live.addEventListener("state", ({ detail }) => {
      this.#axes = detail.axes ?? {};
      this.#progress = detail.measuring ?? null;
      this.#references = detail.references ?? {};
      this.#show();
      this.#bound();
    });
    this.#arrange();
  }

  get canvases() {
    return this.#curves.canvases;
  }

  open() {
    this.#curves.arrange();
  }

  close() {}

  /** Lay the plots out anew, as after a change of the theme. */
  arrange() {
    this.#curves.arrange();
  }

  /** The largest amplitude, µm, that keeps the position within the axis's limits. */
  get #most_um() {
    const held = this.#axes[this.#axis.value]?.reference_um ?? 0;
    return Math.max(0, this.#configuration.limits(this.#axis.value).most_um - Math.abs(held));
  }

  #arrange() {
    const activity = this.#activity.value;
    for (const field of document.querySelectorAll("#measure-form [data-for]")) field.hidden = !field.dataset.for.split(" ").includes(activity);
    say($("measure-note"), ACTIVITIES[activity][2]);
    this.#bound();
  }

  #bound() {
    say($("measure-most"), `µm, at most ${significant(this.#most_um, 3)}, by ${this.#configuration.limits(this.#axis.value).bound}`);
  }

  /** The body of the request. Raises Error for what was typed and is out of bounds. */
  async #body() {
    const [activity, axis] = [this.#activity.value, this.#axis.value];
    if (activity === "learn") {
      const [file] = $("measure-file").files;
      if (!file) throw new Error("scan: no file; choose a file with one period of the scan");
      const { samples } = columns(await file.text());
      return { axis, samples, cycles: fromField($("measure-cycles")), resonance_percent: fromField($("measure-shift")), keep: false };
    }
    const amplitude_um = fromField($("measure-amplitude"));
    if (!(amplitude_um > 0 && amplitude_um <= this.#most_um)) {
      throw new Error(`amplitude: ${amplitude_um} µm; allowed around the setpoint: above 0 and at most ${significant(this.#most_um, 3)} µm`);
    }
    if (activity === "retune") return { axis, amplitude_um, bound_percent: fromField($("measure-bound")), within_percent: fromField($("measure-within")) };
    return { axis, amplitude_um, duration_s: fromField($("measure-duration")), ...(activity === "resonance" ? { resonance_only: true } : {}) };
  }

  async #start() {
    if (this.#under_way) return;
    this.#withdraw("");
    const [activity, request] = [this.#activity.value, new AbortController()];
    this.#under_way = request;
    this.#begun_ms = performance.now();
    this.#show();
    try {
      const body = await this.#body();
      const found = await this.#drive.driving(ACTIVITIES[activity][1], body, $("measure-error"), { signal: request.signal });
      if (request.signal.aborted) this.#withdraw(`Cancelled: axis ${body.axis} returns to its earlier setpoint.`);
      else if (found) this.#take(activity, body.axis, found);
    } catch (error) {
      complain($("measure-error"), error);
    } finally {
      this.#under_way = null;
      this.#show();
    }
  }

  #take(activity, axis, found) {
    say($("measure-done"), `Done: axis ${axis} holds its earlier setpoint again.`);
    if (activity === "retune") {
      showRetuned(found);
      const { replaces, prefilter } = found;
      return this.#propose("retuned", "Swap the new taps in", "Keep the present taps", {
        name: "swap", body: { axis, replaces, prefilter }, done: ({ tick }) => `Swapped in at tick ${tick}.`,
      });
    }
    if (activity === "learn") {
      showLearned(found);
      const { reference_um: samples, command_um } = found;
      return this.#propose("learned", "Play the learned scan", "Discard the learned scan", {
        name: "waveform", body: { axis, samples, command_um, repeat: true }, done: ({ tick }) => `The learned scan plays from tick ${tick} on, until another reference comes.`,
      });
    }
    const nothing = activity === "resonance" && !found.resonance;
    complain($("measure-error"), nothing ? "no lightly damped mode stands out near the model's frequency" : null);
    showMargins(found, activity === "response");
    $("measured-response").hidden = false;
    this.#curves.show(found);
  }

  #propose(part, agree, decline, proposal) {
    this.#proposal = proposal;
    $(`measure-${part}`).hidden = $("measure-consent").hidden = false;
    say($("measure-agree"), agree);
    say($("measure-decline"), decline);
    $("measure-consent").scrollIntoView({ block: "nearest" });
  }

  async #agree() {
    const proposal = this.#proposal;
    if (!proposal) return;
    $("measure-agree").disabled = true;
    const answer = await this.#drive.driving(proposal.name, proposal.body, $("measure-error"));
    $("measure-agree").disabled = false;
    if (!answer) return;
    this.#proposal = null;
    $("measure-consent").hidden = true;
    say($("measure-done"), proposal.done(answer));
    if (proposal.name === "swap") this.#tuned();
  }

  /** Drop the proposal and the results, and say so. */
  #withdraw(text) {
    this.#proposal = null;
    $("measure-consent").hidden = $("measured-response").hidden = true;
    for (const part of PROPOSALS) $(`measure-${part}`).hidden = true;
    complain($("measure-error"), null);
    say($("measure-done"), text);
  }

  /** What the axis plays, if no measurement can begin: the service measures around a constant reference. */
  get #obstacle() {
    const { kind = "hold", text } = this.#references[this.#axis.value] ?? {};
    return kind === "hold" ? "" : text || kind;
  }

  #show() {
    $("measure-start").disabled = !!this.#under_way || !!this.#obstacle;
    $("measure-cancel").disabled = !this.#under_way;
    this.#tell();
  }

  /** Say what is being done, here or for somebody else. */
  #tell() {
    const { activity, axis, rms_um = [], cycles } = this.#progress ?? {};
    const learned = rms_um.length ? `, cycle ${rms_um.length} of ${cycles + 1} is measured: rms error ${fixed(1e3 * rms_um.at(-1), 1)} nm` : "";
    const moves = activity && `axis ${axis} ${activity === "learn" ? "learns" : "is measured"}${learned}`;
    $("measure-lamp").classList.toggle("lit", !!moves);
    const ready = this.#obstacle ? `not ready: axis ${this.#axis.value} has no constant setpoint (${this.#obstacle}); set one first` : "ready";
    if (!this.#under_way) return say($("measure-lamp"), moves ? `${moves}, for another client` : ready);
    const seconds = fixed((performance.now() - this.#begun_ms) / 1000, 0);
    say($("measure-lamp"), `${moves ?? (this.#activity.value === "retune" ? "taps are computed" : "waiting")}, ${seconds} s`);
  }
}
