// Axes and a grid by uPlot; each view draws its curves in the canvas, in pixels of the canvas.

import { palette } from "./palette.js";
import { significant } from "./numbers.js";

const FONT = '11px Inter, system-ui, "Segoe UI", Roboto, "Liberation Sans", Arial, sans-serif';

export class Chart {
  #ranges = { x: [0, 1] };
  #watcher;
  #host;
  #draw;

  /**
   * In `host`. `x` and each of `scales` are {key, unit, log, side, label, values, unitRight}; `bare` leaves the x axis out;
   * `draw(chart, context)` paints.
   */
  constructor(host, { x = {}, scales, draw, bare = false }) {
    this.#host = host;
    this.#draw = draw;
    if (x.log) this.#ranges.x = [0.1, 1];
    for (const { key, log } of scales) this.#ranges[key] = log ? [0.1, 1] : [0, 1];
    const options = {
      ...this.#size(),
      pxAlign: 1,
      legend: { show: false },
      cursor: { drag: { x: false, y: false, setScale: false }, points: { show: false }, x: false, y: false },
      padding: [8, scales.some(({ side }) => side === 1) ? 0 : 26, bare ? 4 : 0, 0],
      scales: Object.fromEntries([
        ["x", { time: false, distr: x.log ? 3 : 1, log: 10 }],
        ...scales.map(({ key, log }) => [key, { distr: log ? 3 : 1, log: 10, range: () => this.#ranges[key] }]),
      ]),
      series: [{}, ...scales.map(({ key }) => ({ scale: key, paths: () => null, points: { show: false } }))],
      axes: [this.#axis({ ...x, key: "x", bare }), ...scales.map((scale, place) => this.#axis(scale, place))],
      hooks: { draw: [(plot) => this.#paint(plot, [x, ...scales])] },
    };
    this.plot = new uPlot(options, [this.#ranges.x, ...scales.map(() => [1, 2])], host);
    this.#watcher = new ResizeObserver(() => this.plot.setSize(this.#size()));
    this.#watcher.observe(host);
  }

  get over() {
    return this.plot.over;
  }

  get pixels() {
    return this.plot.over.clientWidth;
  }

  range(key) {
    return this.#ranges[key];
  }

  /** Limits of an axis, in force with the next `show`. */
  setRange(key, low, high) {
    this.#ranges[key] = [low, high];
  }

  show() {
    const [min, max] = this.#ranges.x;
    this.plot.setScale("x", { min, max });
  }

  /** Place on the canvas; `css` in pixels of the page within the plot. */
  at(value, key, css = false) {
    return this.plot.valToPos(value, key, !css);
  }

  value(css_px, key) {
    return this.plot.posToVal(css_px, key);
  }

  destroy() {
    this.#watcher.disconnect();
    this.plot.destroy();
  }

  #size() {
    return { width: Math.max(this.#host.clientWidth, 80), height: Math.max(this.#host.clientHeight, 60) };
  }

  #axis({ key, side = 3, log = false, bare = false, values }, place = 0) {
    const upright = key !== "x";
    return {
      scale: key,
      side: upright ? side : 2,
      show: true,
      size: upright ? 54 : bare ? 2 : 26,
      gap: upright ? 4 : 7, // the lowest number of an upright axis stands beside the first below it
      font: FONT,
      space: (_plot, _axis, _low, _high, length_px) => Math.max(upright ? 34 : 70, length_px / 13),
      stroke: () => palette().text,
      grid: { show: !upright || place === 0, stroke: () => palette().grid, width: 1 },
      ticks: { show: false },
      values: bare ? (_, ticks) => ticks.map(() => "") : values ?? (log ? decades : plainTicks),
    };
  }

  #paint(plot, scales) {
    const { ctx, bbox } = plot;
    const ratio = devicePixelRatio;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    this.#draw(this, ctx);
    ctx.restore();
    ctx.save();
    ctx.font = FONT.replace("11px", `${11 * ratio}px`);
    ctx.fillStyle = palette().strong;
    for (const { unit, key = "x", side = 3, unitRight = false } of scales) {
      if (!unit) continue;
      const right = key === "x" || side === 1 || unitRight;
      ctx.textAlign = right ? "right" : "left";
      ctx.textBaseline = key === "x" ? "bottom" : "top";
      const y = key === "x" ? bbox.top + bbox.height - 3 * ratio : bbox.top + 3 * ratio;
      ctx.strokeStyle = palette().back; // around the letters, where traces run
      ctx.lineWidth = 4 * ratio;
      ctx.lineJoin = "round";
      for (const put of [ctx.strokeText, ctx.fillText]) put.call(ctx, unit, right ? bbox.left + bbox.width - 5 * ratio : bbox.left + 5 * ratio, y);
    }
    ctx.restore();
  }
}

const plainTicks = (_, ticks) => {
  const step = ticks.length > 1 ? Math.abs(ticks[1] - ticks[0]) : 1;
  let decimals = 0;
  while (decimals < 7 && Math.abs(step * 10 ** decimals - Math.round(step * 10 ** decimals)) > 1e-6) decimals++;
  return ticks.map((tick) => tick.toFixed(decimals).replace("-", "−"));
};

/** Labels at powers of ten alone. */
const decades = (_, ticks) =>
  ticks.map((tick) => (tick && Math.abs(Math.log10(tick) % 1) < 1e-6 ? (tick >= 1e6 ? `${tick / 1e6}M` : tick >= 1e4 ? `${tick / 1e3}k` : significant(tick, 1)) : ""));

/** Limits of round numbers that hold `low` … `high`; those in force stay while they suit. */
export function roundLimits(low, high, now, least = 0.02) {
  if (!(low <= high)) return now ?? [-1, 1];
  if (now && low >= now[0] && high <= now[1] && (high - low > 0.55 * (now[1] - now[0]) || now[1] - now[0] <= 2.1 * least)) return now;
  const middle = (low + high) / 2;
  const half = Math.max((high - low) * 0.56, least);
  const step = 10 ** Math.floor(Math.log10(half / 2));
  return [Math.floor((middle - half) / step) * step, Math.ceil((middle + half) / step) * step];
}

/** A line over points (x, y) on the canvas, broken at NaN. */
export function polyline(ctx, count, x, y) {
  ctx.beginPath();
  let down = false;
  for (let point = 0; point < count; point++) {
    const level = y(point);
    if (Number.isNaN(level)) down = false;
    else if (down) ctx.lineTo(x(point), level);
    else {
      ctx.moveTo(x(point), level);
      down = true;
    }
  }
  ctx.stroke();
}
