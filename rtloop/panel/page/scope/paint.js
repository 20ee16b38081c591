// A trace of a sweep: a line through samples, a band with its middle where a pixel holds many.

import { polyline } from "../chart.js";

/** `trace` is {name, colour, dash}; `key` its scale; `faded` 0 … 1 what is left of it. */
export function paintTrace(chart, ctx, sweep, trace, key, faded = 1) {
  const low = sweep.arrays[`${trace.name}:low`];
  const high = sweep.arrays[`${trace.name}:high`];
  const offset = sweep.arrays.offset;
  if (!low || offset.length === 0) return;
  const x0 = chart.at(0, "x");
  const per_tick = chart.at(1, "x") - x0;
  const y0 = chart.at(0, key);
  const per_unit = chart.at(1, key) - y0;
  const ratio = devicePixelRatio;
  const x = (point) => x0 + (offset[point] / sweep.rate_hz) * per_tick;
  const y = (values) => (point) => y0 + values[point] * per_unit;
  ctx.save();
  ctx.globalAlpha = faded;
  ctx.strokeStyle = ctx.fillStyle = trace.colour;
  ctx.lineJoin = "round";
  ctx.lineWidth = 1.4 * ratio;
  if (isBand(low, high, Math.abs(per_unit), ratio)) {
    ctx.globalAlpha = faded * 0.4;
    band(ctx, offset.length, x, y(low), y(high));
    ctx.globalAlpha = faded;
  }
  ctx.setLineDash(trace.dash.map((length) => length * ratio));
  const [first, second] = [y(low), y(high)];
  polyline(ctx, offset.length, x, (point) => (first(point) + second(point)) / 2);
  ctx.restore();
}

/** Whether somewhere more than a line's width lies between lowest and highest. */
function isBand(low, high, per_unit, ratio) {
  for (let point = 0; point < low.length; point++) if ((high[point] - low[point]) * per_unit > ratio) return true;
  return false;
}

function band(ctx, count, x, low, high) {
  let first = 0;
  while (first < count) {
    while (first < count && Number.isNaN(low(first))) first++;
    let end = first;
    while (end < count && !Number.isNaN(low(end))) end++;
    ctx.beginPath();
    for (let point = first; point < end; point++) ctx.lineTo(x(point), high(point) - 0.5);
    for (let point = end - 1; point >= first; point--) ctx.lineTo(x(point), low(point) + 0.5);
    ctx.fill();
    first = end;
  }
}
