// A list to choose one entry. The browser's own list keeps the keyboard while it is open, but Space must stop.

import { make, say } from "./dom.js";

export class Picker {
  #button;
  #list;
  #options = [];
  #value;
  #at = 0;
  #change;

  /** In `host`, which names itself by data-label; `change` hears of each choice. */
  constructor(host, change) {
    const label = host.dataset.label;
    this.#change = change;
    this.#button = make("button", {
      type: "button", class: "choice", "aria-haspopup": "listbox", "aria-expanded": "false",
      click: () => this.#toggle(), keydown: (event) => this.#onButton(event),
    });
    this.#list = make("ul", {
      role: "listbox", tabindex: "-1", id: `${host.id}-list`, "aria-label": label, hidden: true,
      keydown: (event) => this.#onList(event), focusout: () => this.#close(),
    });
    this.#button.setAttribute("aria-controls", this.#list.id);
    this.label = label;
    host.classList.add("picker");
    host.append(this.#button, this.#list);
  }

  get value() {
    return this.#value;
  }

  set value(value) {
    this.#value = value;
    const text = this.#options.find((option) => option.value === value)?.text ?? String(value ?? "—");
    say(this.#button, text);
    this.#button.setAttribute("aria-label", `${this.label}: ${text}`);
  }

  set disabled(disabled) {
    this.#button.disabled = disabled;
  }

  /** [{value, text}]; the value in force stays where it still is one. */
  set options(options) {
    this.#options = options;
    this.#list.replaceChildren(
      ...options.map((option, place) =>
        make("li", {
          role: "option", id: `${this.#list.id}-${place}`, "aria-selected": "false",
          pointerdown: (event) => event.preventDefault(),
          click: () => this.#choose(place),
        }, option.text)),
    );
    const known = options.some((option) => option.value === this.#value);
    this.value = known ? this.#value : options[0]?.value;
  }

  #toggle() {
    if (!this.#list.hidden) return this.#close();
    this.#list.hidden = false;
    const { top, bottom } = this.#button.getBoundingClientRect();
    this.#list.classList.toggle("upward", innerHeight - bottom < this.#list.offsetHeight && top > innerHeight - bottom);
    this.#button.setAttribute("aria-expanded", "true");
    this.#go(Math.max(0, this.#options.findIndex((option) => option.value === this.#value)));
    this.#list.focus();
  }

  #close() {
    this.#list.hidden = true;
    this.#button.setAttribute("aria-expanded", "false");
  }

  #go(place) {
    this.#at = Math.min(Math.max(place, 0), this.#options.length - 1);
    for (const [number, item] of [...this.#list.children].entries()) {
      item.setAttribute("aria-selected", String(number === this.#at));
    }
    const item = this.#list.children[this.#at];
    if (!item) return;
    this.#list.setAttribute("aria-activedescendant", item.id);
    item.scrollIntoView({ block: "nearest" });
  }

  #choose(place) {
    this.#close();
    this.#button.focus();
    const { value } = this.#options[place];
    if (value === this.#value) return;
    this.value = value;
    this.#change?.(value);
  }

  #onButton(event) {
    if (event.key !== "ArrowDown" && event.key !== "ArrowUp") return;
    event.preventDefault();
    this.#toggle();
  }

  #onList(event) {
    const places = { ArrowDown: this.#at + 1, ArrowUp: this.#at - 1, Home: 0, End: this.#options.length - 1 };
    const finds = (option) => option.text.toLowerCase().startsWith(event.key.toLowerCase());
    if (event.key in places) this.#go(places[event.key]);
    else if (event.key === "Enter") this.#choose(this.#at);
    else if (event.key === "Escape") this.#button.focus();
    else if (/^[^\s]$/.test(event.key) && this.#options.some(finds)) this.#go(this.#options.findIndex(finds));
    else return;
    event.preventDefault();
    event.stopPropagation();
  }
}
