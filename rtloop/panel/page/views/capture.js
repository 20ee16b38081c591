// The screen as a picture, and its ticks as a recording.

import { post } from "../api.js";
import { $ } from "../dom.js";
import { counted } from "../numbers.js";
import { palette } from "../palette.js";

const MARGIN = 14;
const LINE = 18;

/** Download a picture of the plots with what they show in words, and have the service's recording cut. */
export async function capture(view, panel, state, say) {
  const stem = `${panel.name}-tick-${state?.tick ?? 0}`;
  const sweep = view.scope?.sweep;
  save(await picture(view, panel, state), `${stem}.png`);
  say("Capturing…");
  const wanted = sweep ? { run: sweep.run, first: Math.max(sweep.first, 0), end: sweep.end } : { seconds: view.seconds ?? 1 };
  const made = await post("/api/capture", wanted);
  say(`Captured ${counted(made.ticks)} ticks: ${made.file}, replay ${made.replay}`);
  return made;
}

function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

function picture({ canvases, lines, traces }, panel, state) {
  const ratio = devicePixelRatio;
  const width = Math.max(...canvases.map((canvas) => canvas.width), 600 * ratio);
  const words = [`rtloop ${panel.name} · ${new Date().toISOString()} · tick ${state?.tick ?? "—"} · ${state?.state ?? "—"}`, ...lines];
  const height = canvases.reduce((sum, canvas) => sum + canvas.height, 0) + (words.length + traces.length) * LINE * ratio + 2 * MARGIN * ratio;
  const sheet = document.createElement("canvas");
  [sheet.width, sheet.height] = [width, height];
  const ctx = sheet.getContext("2d");
  ctx.fillStyle = palette().back;
  ctx.fillRect(0, 0, width, height);
  ctx.font = `${12 * ratio}px ${getComputedStyle($("main")).fontFamily}`;
  ctx.textBaseline = "top";
  let y = MARGIN * ratio;
  const write = (text, colour, x = MARGIN) => {
    ctx.fillStyle = colour;
    ctx.fillText(text, x * ratio, y);
    y += LINE * ratio;
  };
  for (const text of words) write(text, palette().strong);
  for (const canvas of canvases) {
    ctx.drawImage(canvas, 0, y);
    y += canvas.height;
  }
  for (const { text, colour, dash } of traces) {
    ctx.strokeStyle = colour;
    ctx.lineWidth = 2 * ratio;
    ctx.setLineDash(dash.map((length) => length * ratio));
    ctx.beginPath();
    ctx.moveTo(MARGIN * ratio, y + 7 * ratio);
    ctx.lineTo((MARGIN + 30) * ratio, y + 7 * ratio);
    ctx.stroke();
    write(text, palette().strong, MARGIN + 38);
  }
  return new Promise((resolve) => sheet.toBlob(resolve, "image/png"));
}
