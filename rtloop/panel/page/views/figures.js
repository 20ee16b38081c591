// A row of figures with their names beneath a plot.

import { make, say } from "../dom.js";

/** Show {name: text} in a definition list; what is there already is only changed. */
export function showFigures(list, figures) {
  const names = Object.keys(figures);
  if (list.dataset.names !== names.join()) {
    list.dataset.names = names.join();
    list.replaceChildren(...names.map((name) => make("div", {}, make("dt", {}, name), make("dd", {}))));
  }
  for (const [place, name] of names.entries()) say(list.children[place].lastElementChild, figures[name]);
}
