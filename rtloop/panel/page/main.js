// The page: its session, its connection and its parts.

import { get, who } from "./api.js";
import { Configuration } from "./desk/configuration.js";
import { showDigits } from "./desk/digits.js";
import { Drive } from "./desk/drive.js";
import { showEvents } from "./desk/events.js";
import { Reference } from "./desk/reference.js";
import { Tuning } from "./desk/tuning.js";
import { $ } from "./dom.js";
import { Keys } from "./keys.js";
import { Live } from "./live.js";
import { Measure } from "./measure/measure.js";
import { themes } from "./palette.js";
import { Scope } from "./scope/scope.js";
import { askForToken, openSession } from "./session.js";
import { Strip } from "./strip.js";
import { Views } from "./views/views.js";

function closeHelp() {
  if (!$("help-dialog").open) return;
  $("help-dialog").close();
  $("help").focus();
}

const live = new Live();
const strip = new Strip(live);
const drive = new Drive(live, strip);
const keys = new Keys(() => drive.stop());
let views = null;
let tuning = null;
themes($("theme"), () => {
  views?.arrange();
  tuning?.arrange();
});
$("tunnel").textContent = `ssh -o ExitOnForwardFailure=yes -L ${location.host}:${location.host} USER@HOST`;
$("help").addEventListener("click", () => ($("help-dialog").open ? closeHelp() : $("help-dialog").show())); // not modal: STOP stays in reach
$("close-help").addEventListener("click", closeHelp);
live.addEventListener("refused", ({ detail }) => strip.tell(`${detail.wish}: ${detail.error}`));
addEventListener("rtloop-session-lost", () => askForToken());

const panel = await openSession(get, () => live.connect());
$("name").textContent = panel.name;
strip.begin(get);
const configuration = new Configuration(panel);
showDigits(live, panel, configuration);
showEvents(live);
const scope = new Scope(live, panel);
const measure = new Measure(live, panel, configuration, drive, () => tuning.read());
views = new Views(live, panel, scope, strip, measure);
const reference = new Reference(live, panel, configuration, drive, () => tuning.read());
tuning = new Tuning(drive, configuration, () => reference.axis);
tuning.read();
live.connect();
let run = null;
live.addEventListener("state", async ({ detail }) => {
  if (detail.run == null || detail.run === run) return;
  const another = run !== null;
  run = detail.run;
  if (!another) return;
  const now = await get("/api/panel").catch(() => panel);
  if (JSON.stringify(now) !== JSON.stringify(panel)) location.reload(); // the loop that came has other signals, or another rate
  else tuning.read();
});
live.addEventListener("events", ({ detail }) => {
  const others = detail.events.some((event) => event.kind === "load_law" && event.who !== who.name);
  if (others) setTimeout(() => tuning.read(), 500); // the service says so soon after the tick
});

const press = (id) => () => $(id).click();
const focus = (id) => () => {
  $(id).focus();
  $(id).select?.();
};
keys.on("g", () => drive.go.begin(), () => drive.go.end());
keys.on("s", focus("setpoint"));
keys.on("k", focus("tune-value"));
keys.on("l", focus("who"));
keys.on("u", press("undo"));
keys.on("c", press("capture"));
keys.on("h", press("hold"));
keys.on("f", press("force"));
keys.on("a", press("arm-single"));
keys.on("m", press("cursors"));
keys.on("[", () => reference.jog(-1));
keys.on("]", () => reference.jog(1));
for (const key of ["+", "="]) keys.on(key, press("longer"));
for (const key of ["-", "−"]) keys.on(key, press("shorter"));
for (const [place, button] of [...document.querySelectorAll("#views [data-view]:not(.narrow)")].entries()) keys.on(String(place + 1), () => button.click());
keys.on("?", press("help"));
keys.on("Escape", closeHelp);
