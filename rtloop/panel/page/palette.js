// Colours of traces (after Okabe and Ito, distinct for colour-blind people) and their dashes.

export const DASHES = [[], [7, 3], [2, 2.5], [10, 3, 2, 3], [14, 4], [1.5, 4], [8, 2, 2, 2, 2, 2], [4, 4]];
const NAMES = ["--trace-1", "--trace-2", "--trace-3", "--trace-4", "--trace-5", "--trace-6", "--trace-7", "--trace-8"];

let colours = {};

function read() {
  const style = getComputedStyle(document.documentElement);
  const of = (name) => style.getPropertyValue(name).trim();
  colours = {
    traces: NAMES.map(of),
    grid: of("--grid"),
    text: of("--faint"),
    strong: of("--text"),
    cursor: of("--cursor"),
    back: of("--plot"),
    model: of("--model"),
  };
}

/** Of the theme in force. */
export const palette = () => colours;

/** Keep to the system's theme, or to what was switched to; `changed` is called whenever it is another one. */
export function themes(button, changed) {
  const root = document.documentElement;
  const system = matchMedia("(prefers-color-scheme: dark)");
  const apply = () => {
    root.dataset.theme = localStorage.getItem("rtloop-theme") ?? (system.matches ? "dark" : "light");
    button.setAttribute("aria-pressed", String(root.dataset.theme === "dark"));
    read();
    changed();
  };
  button.addEventListener("click", () => {
    const other = root.dataset.theme === "dark" ? "light" : "dark";
    if (other === (system.matches ? "dark" : "light")) localStorage.removeItem("rtloop-theme");
    else localStorage.setItem("rtloop-theme", other);
    apply();
  });
  system.addEventListener("change", apply);
  apply();
}
