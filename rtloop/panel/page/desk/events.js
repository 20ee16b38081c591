// Events, newest first: commands, mode changes, trips, each with its tick, operator, old and new value.

import { $, make } from "../dom.js";
import { counted } from "../numbers.js";

const MOST = 200;
const [LATE, GAP] = ["periods_missed", "gap"];
/** Late ticks without anything else between them, and lost ticks: one row, told again as it grows. */
const CALLED = { [LATE]: "", [GAP]: "", load_law: "tuned", set_reference: "reference", set_mode: "mode", reset_trip: "reset" };

/** A blank between a number and its unit, where a line must not break. */
const BEFORE_UNIT = /(?<=\d) (?=(?:µm|µs|ms|s|V|Hz|kHz|%)(?![\p{L}\d]))/gu;

const keyOf = (event) => ([LATE, GAP].includes(event.kind) ? `${event.kind} ${event.who} ${event.run} ${event.tick}` : JSON.stringify({ ...event, who: null }));

function rowOf({ tick, kind, who, axis, what }) {
  const tripped = kind === "tripped"; // its words begin with the axis
  const called = kind === "set_mode" && what?.mode === "off" ? "stopped" : CALLED[kind] ?? String(kind).replaceAll("_", " ");
  const text = [!tripped && axis, called, what?.text].filter(Boolean).join(" · ").replace(BEFORE_UNIT, "\u00a0");
  return make("li", { class: tripped && "trip", title: text }, make("span", {}, counted(tick)), make("span", {}, who ?? ""), text);
}

/** Between the events of two runs: ticks count from 0 again, for a reason that the service may know. */
function startOf(reason) {
  const why = reason && `${reason[0].toUpperCase()}${reason.slice(1)}. `;
  return make("li", { class: why ? "start trip" : "start" }, `${why ?? ""}The loop started again: ticks count from 0.`);
}

export function showEvents(live) {
  const rows = new Map();
  const add = (key, row) => {
    if (rows.has(key)) rows.get(key).replaceWith(row); // it grew, or says who asked, or is said again after a break
    else $("events").prepend(row);
    rows.set(key, row);
  };
  const starts = new Map(); // reason by run
  const showStart = (run, reason) => {
    if (starts.has(run) && (starts.get(run) || !reason)) return;
    starts.set(run, reason);
    add(`start ${run}`, startOf(reason));
  };
  let [newest, shown] = [null, null]; // runs: of the states, and of the events
  live.addEventListener("state", ({ detail: { run, faults } }) => {
    if (run == null) return;
    if (newest !== null && run > newest) showStart(run);
    newest = run;
    if (starts.has(run) && faults?.length) showStart(run, faults.join("; "));
  });
  live.addEventListener("events", ({ detail }) => {
    for (const event of detail.events) {
      if (shown !== null && event.run > shown) showStart(event.run);
      shown = event.run ?? shown;
      add(keyOf(event), rowOf(event));
    }
    for (const [key, row] of [...rows].slice(0, -MOST)) {
      row.remove();
      rows.delete(key);
    }
  });
}
