// The keyboard. Space stops, whatever has the focus; only a field of free text takes it as a blank.

import { $ } from "./dom.js";

const FREE_TEXT = "textarea, input[data-free-text]";

const typed = (target) => target instanceof Element && target.matches("input:not([type=range]):not([type=checkbox]), textarea");

/** Letters and signs are short cuts only while they are switched on, and never while something is typed. */
export class Keys {
  #actions = new Map();
  #releases = new Map();

  constructor(stop) {
    this.letters = localStorage.getItem("rtloop-letters") !== "off";
    addEventListener("keydown", (event) => this.#down(event, stop), { capture: true });
    addEventListener("keyup", (event) => this.#up(event), { capture: true });
    addEventListener("focusin", ({ target }) => {
      document.body.classList.toggle("typing", target.matches(FREE_TEXT));
    });
    addEventListener("focusout", () => document.body.classList.remove("typing"));
    const box = $("letters");
    box.checked = this.letters;
    box.addEventListener("change", () => {
      this.letters = box.checked;
      localStorage.setItem("rtloop-letters", box.checked ? "on" : "off");
    });
  }

  /** `action` at the press of `key`, `released` when it goes up again. */
  on(key, action, released) {
    this.#actions.set(key, action);
    if (released) this.#releases.set(key, released);
  }

  #down(event, stop) {
    const { key, target } = event;
    if (key === " ") return this.#space(event, stop);
    if (key === "Escape" && typed(target)) return target.blur();
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    if (key === "Enter" && target.matches?.("input[type=checkbox]")) {
      event.preventDefault();
      target.click();
    }
    if (key === "Enter" && event.repeat && target.matches?.("button")) event.preventDefault(); // a key that is held presses it once
    const inside = document.querySelector("dialog:modal") || target.closest?.("[role=listbox]");
    if (inside || event.repeat || (key !== "Escape" && (typed(target) || !this.letters))) return;
    const action = this.#actions.get(key.length === 1 ? key.toLowerCase() : key);
    if (!action) return;
    event.preventDefault();
    action();
  }

  /** A blank is typed where it is one and no Shift is held; else it stops, and does nothing that the focus would. */
  #space(event, stop) {
    if (event.target.matches?.(FREE_TEXT) && !event.shiftKey) return;
    event.preventDefault();
    event.stopPropagation();
    if (!event.repeat) stop();
  }

  #up(event) {
    if (event.key === " " && !event.target.matches?.(FREE_TEXT)) event.preventDefault();
    if (event.key.length === 1) this.#releases.get(event.key.toLowerCase())?.();
  }
}
