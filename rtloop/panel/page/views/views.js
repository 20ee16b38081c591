// The visible views: one, or the scope and another beside it on a large screen.

import { $, complain } from "../dom.js";
import { duration } from "../numbers.js";
import { DASHES, palette } from "../palette.js";
import { capture } from "./capture.js";
import { Recordings } from "./recordings.js";
import { Spectrum } from "./spectrum.js";
import { Timing } from "./timing.js";
import { Xy } from "./xy.js";

const large = matchMedia("(min-width: 118rem)");

export class Views {
  #parts;
  #chosen = "scope";
  #beside = "xy";
  #scope;

  /** `measure` is the view that measures the loop. */
  constructor(live, panel, scope, strip, measure) {
    this.#scope = scope;
    this.#parts = { xy: new Xy(live, panel), spectrum: new Spectrum(live, panel), timing: new Timing(live), recordings: new Recordings(scope), measure };
    for (const button of document.querySelectorAll("#views [data-view]")) {
      button.addEventListener("click", () => this.choose(button.dataset.view));
    }
    large.addEventListener("change", () => this.choose(this.#chosen));
    let busy = false;
    $("capture").addEventListener("click", async () => {
      if (busy) return;
      busy = true;
      try {
        await capture(this.#picture(), panel, strip.state, (text) => strip.tell(text, 15_000));
        if (!$("recordings").hidden) this.#parts.recordings.open();
      } catch (error) {
        strip.tell(`The recording was not captured: ${error.message}`, 15_000);
      }
      busy = false;
    });
    this.choose("scope");
  }

  choose(name) {
    if (name === "desk") return $("desk").scrollIntoView();
    this.#chosen = name;
    if (name !== "scope") this.#beside = name;
    const other = large.matches ? this.#beside : name;
    for (const button of document.querySelectorAll("#views [data-view]")) {
      const seen = button.dataset.view === other || (large.matches && button.dataset.view === "scope");
      if (seen) button.setAttribute("aria-current", "true");
      else button.removeAttribute("aria-current");
    }
    $("scope").hidden = !large.matches && name !== "scope";
    this.#scope.redraw();
    for (const [part, view] of Object.entries(this.#parts)) {
      const hidden = part !== other;
      const was = $(part).hidden;
      $(part).hidden = hidden;
      if (hidden && !was) view.close();
      if (!hidden && (was || part === "recordings")) view.open();
    }
    complain($("recordings-error"), null);
    if ($("main").getBoundingClientRect().top < 0) $("main").scrollIntoView();
  }

  /** Colours are others. */
  arrange() {
    this.#scope.arrange();
    for (const [part, view] of Object.entries(this.#parts)) if (!$(part).hidden) view.arrange();
  }

  /** What is on the screen, for a picture: plots, words about them, and what is drawn how. */
  #picture() {
    const [part, view] = Object.entries(this.#parts).find(([name]) => !$(name).hidden) ?? [];
    const plots = [...($("scope").hidden ? [] : this.#scope.canvases), ...(view?.canvases ?? [])];
    const lines = part ? [...$(part).querySelectorAll(".figures > div")].map((one) => `${one.firstChild.textContent}: ${one.lastChild.textContent}`) : [];
    const traces = $("scope").hidden
      ? [{ text: part, colour: palette().traces[0], dash: DASHES[0] }]
      : [...$("traces").tBodies[0].rows].map((row, place) => ({ text: described(row), colour: palette().traces[place], dash: DASHES[place] }));
    const scope = $("scope").hidden ? null : this.#scope;
    return { canvases: plots.filter((canvas) => canvas.width), lines: [...(scope ? [`scope: ${duration(scope.view.seconds, 2)} a screen. ${$("measured").textContent}`] : []), ...lines], traces, scope, seconds: view?.seconds };
  }
}

/** A row of the table of traces in one line. */
function described(row) {
  const [name, unit, low, high, mean, , deviation] = [...row.cells].map((cell) => cell.textContent);
  return `${name}: ${low} … ${high}${unit && ` ${unit}`}, mean ${mean}, σ ${deviation}`;
}
