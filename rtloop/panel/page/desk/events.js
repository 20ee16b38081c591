// Events, newest first: commands, mode changes, trips, each with its tick, operator, old and new value.

import { $, make } from "../dom.js";
import { counted } from "../numbers.js";

const MOST = 200;
const LATE = "periods_missed";
/** Late ticks without anything else between them: one row, told again as it grows. */
const CALLED = { [LATE]: "", load_law: "tuned", set_reference: "reference", set_mode: "mode", reset_trip: "reset" };

const keyOf = (event) => (event.kind === LATE ? `${event.run} ${event.tick}` : JSON.stringify({ ...event, who: null }));

function rowOf({ tick, kind, who, axis, what }) {
  const tripped = kind === "tripped"; // its words begin with the axis
  const called = kind === "set_mode" && what?.mode === "off" ? "stopped" : CALLED[kind] ?? String(kind).replaceAll("_", " ");
  const text = [!tripped && axis, called, what?.text].filter(Boolean).join(" · ");
  return make("li", { class: tripped && "trip", title: text }, make("span", {}, counted(tick)), make("span", {}, who ?? ""), text);
}

export function showEvents(live) {
  const rows = new Map();
  live.addEventListener("events", ({ detail }) => {
    for (const event of detail.events) {
      const [key, row] = [keyOf(event), rowOf(event)];
      if (rows.has(key)) rows.get(key).replaceWith(row); // it grew, or says who asked, or is said again after a break
      else $("events").prepend(row);
      rows.set(key, row);
    }
    for (const [key, row] of [...rows].slice(0, -MOST)) {
      row.remove();
      rows.delete(key);
    }
  });
}
