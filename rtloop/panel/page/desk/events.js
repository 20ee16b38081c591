// What happened, newest first: commands, changes of mode, trips, each with its tick and who asked for it.

import { $, make } from "../dom.js";
import { counted } from "../numbers.js";

const MOST = 200;

export function showEvents(live) {
  const seen = new Set();
  live.addEventListener("events", ({ detail }) => {
    const list = $("events");
    for (const event of detail.events) {
      const said = JSON.stringify(event);
      if (seen.has(said)) continue; // said again after a break
      seen.add(said);
      if (seen.size > 2 * MOST) seen.delete(seen.values().next().value);
      const { tick, kind, who, axis, what } = event;
      const tripped = kind === "tripped";
      const text = [axis, String(kind).replaceAll("_", " "), what?.text].filter(Boolean).join(" · ");
      list.prepend(make("li", { class: tripped && "trip", title: text }, make("span", {}, counted(tick)), make("span", {}, who ?? ""), text));
    }
    while (list.children.length > MOST) list.lastElementChild.remove();
  });
}
