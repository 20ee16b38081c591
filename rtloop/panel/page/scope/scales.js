// Limits of the scales; fields to enter them while the scales do not follow the traces.

import { $, complain, make } from "../dom.js";
import { fromField, significant } from "../numbers.js";

/** Fields for the scales of `lanes`, none where they follow the traces; `changed` is called when one was typed. */
export function showScales(lanes, autoscale, changed) {
  const fields = autoscale ? [] : lanes.lanes.flatMap((lane) => lane.units.map((unit) => field(lanes, lane, unit, changed)));
  $("scales").replaceChildren(...fields);
}

function field(lanes, lane, unit, changed) {
  const id = `${lane.id}/${unit}`;
  const name = lane.id === "all" ? unit : lane.id;
  const ends = (lanes.limits.get(id) ?? [-1, 1]).map((value, place) => make("input", { value: significant(value, 4).replace("−", "-"), size: 6, "aria-label": `${name}: ${place ? "highest" : "lowest"}` }));
  const read = () => {
    try {
      const [lowest, highest] = ends.map(fromField);
      if (lowest >= highest) throw new Error(`${name}: from ${lowest} to ${highest}; allowed: the lower end before the higher`);
      lanes.setLimits(id, lowest, highest);
      complain($("trigger-error"), null);
      changed();
    } catch (error) {
      complain($("trigger-error"), error);
    }
  };
  for (const end of ends) end.addEventListener("change", read);
  return make("span", { class: "field" }, make("span", {}, name), ends[0], "…", ends[1]);
}
