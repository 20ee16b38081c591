// The axes in large digits, as many times a second as an eye can follow.

import { $, make, reducedMotion, say } from "../dom.js";
import { fixed, quantity } from "../numbers.js";

const EVERY_MS = 150;

/** Show the axes of `panel` from the states that come. */
export function showDigits(live, panel, configuration) {
  const shown = panel.axes.map((axis) => {
    const part = (name, unit) => {
      const [value, of] = [make("span", {}, "—"), make("span", {}, unit)];
      return [value, make("div", {}, make("dt", {}, name), make("dd", {}, value, " ", of)), of];
    };
    const large = make("span", { id: `position-${axis}` }, "—");
    const fill = make("i");
    const [reference, first, unit] = part("reference", "µm");
    const [error, second] = part("error", "µm");
    const [drive, third] = part("drive", "V");
    const box = make("div", { role: "group", "aria-label": `Axis ${axis}` },
      make("p", { class: "axis-name" }, `${axis} · position`),
      make("p", { class: "large" }, large, make("small", {}, " µm")),
      make("dl", { class: "lesser" }, first, second, third),
      make("div", { class: "meter", "aria-hidden": "true" }, fill));
    const brief = make("dd", {}, "—");
    return { axis, box, large, reference, unit, error, drive, fill, brief };
  });
  $("digits").replaceChildren(...shown.map(({ box }) => box));
  document.querySelector(".vitals").prepend(...shown.map(({ axis, brief }) => make("div", { class: "brief" }, make("dt", {}, axis), brief)));
  let last_ms = 0;
  live.addEventListener("state", ({ detail }) => {
    const now_ms = performance.now();
    if (!detail.axes || now_ms - last_ms < EVERY_MS * (reducedMotion.matches ? 4 : 1)) return;
    last_ms = now_ms;
    const raw = detail.mode === "raw"; // the reference is the drive then, and there is nothing to be off from
    for (const { axis, large, reference, unit, error, drive, fill, brief } of shown) {
      const values = detail.axes[axis] ?? {};
      say(unit, raw ? "V" : "µm");
      say(large, quantity(values.position_um, "µm"));
      say(reference, raw ? fixed(values.reference_um, 3) : quantity(values.reference_um, "µm"));
      say(error, raw ? "—" : quantity(values.error_um, "µm"));
      say(drive, fixed(values.drive_v, 3));
      say(brief, `${large.textContent} µm, ${drive.textContent} V`);
      const { lowest_v, highest_v } = configuration.limits(axis);
      const place = (volts) => Math.min(Math.max(((volts - lowest_v) / (highest_v - lowest_v)) * 100, 0), 100);
      const [zero, now] = [place(0), place(values.drive_v ?? 0)];
      fill.style.left = `${Math.min(zero, now)}%`;
      fill.style.width = `${Math.abs(now - zero)}%`;
    }
  });
}
