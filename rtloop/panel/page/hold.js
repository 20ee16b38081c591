// A button that acts after one second: held by pointer, by Enter, or by its letter.

const HOLD_MS = 1000;

export class HoldButton {
  #element;
  #act;
  #timer = null;

  constructor(element, act) {
    this.#element = element;
    this.#act = act;
    element.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      element.setPointerCapture(event.pointerId); // a page that moves beneath the finger lets nothing go
      this.begin();
    });
    for (const end of ["pointerup", "pointercancel", "blur"]) {
      element.addEventListener(end, () => this.end());
    }
    element.addEventListener("keydown", (event) => event.key === "Enter" && !event.repeat && this.begin());
    element.addEventListener("keyup", (event) => event.key === "Enter" && this.end());
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    addEventListener("blur", () => this.end());
  }

  begin() {
    if (this.#element.disabled || this.#timer !== null) return;
    this.#element.classList.add("holding");
    this.#timer = setTimeout(() => {
      this.end();
      this.#act();
    }, HOLD_MS);
  }

  end() {
    clearTimeout(this.#timer);
    this.#timer = null;
    this.#element.classList.remove("holding");
  }
}
