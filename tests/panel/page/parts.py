"""The modules of the page in a browser without a panel; files and events of the test replace the server."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from rtloop.panel.web.application import PAGE
from tests.panel.page.browser import TIMEOUT_S, await_text

SET_UP = """async () => {
  const names = ["scope/scope", "views/xy", "views/spectrum", "views/recordings", "palette", "strip"];
  names.push(...["reference", "drive", "events", "configuration", "digits"].map((name) => `desk/${name}`));
  const parts = await Promise.all(names.map((name) => import(`/page/${name}.js`)));
  const {Scope, Reference, Drive, showEvents, showDigits, Configuration, Xy, Spectrum, Recordings, Strip, themes} =
    Object.assign({}, ...parts);
  const live = Object.assign(new EventTarget(), {wish(more) { Object.assign(window.wishes, more) }, once() {}});
  const units = {x_position_um: "µm", x_reference_um: "µm", x_drive_v: "V", tick: "1", y_drive_v: "V"};
  const columns = Object.entries(units).map(([name, unit]) => ({name, unit}));
  const defaults = {limits: {command_um: 30}, interlocks: {}};
  const panel = {axes: ["x", "y"], longest_s: 60, rate_hz: 1000, columns, defaults};
  const arrays = {offset: Float32Array.from({length: 200}, (_, tick) => tick - 40)};
  for (const {name} of columns) {
    arrays[`${name}:low`] = arrays[`${name}:high`] = arrays.offset.map((tick) => 12 + Math.sin(tick / 9));
  }
  themes(document.getElementById("theme"), () => {});
  window.wishes = {};
  window.dispatch = (kind, detail) => live.dispatchEvent(new CustomEvent(kind, {detail}));
  window.sweep = (more) => dispatch("sweep", {run: 0, first: 0, trigger: 40, end: 200, cause: "auto", mode: "auto",
    uncertain_ticks: 0, number: 3, complete: true, rate_hz: 1000, arrays, ...more});
  window.state = (more) => dispatch("state", {state: "stopped", mode: "off", tick: 7, unix_s: 1000, axes: {},
    lock: {name: "ada", until_unix_s: 1042}, ...more});
  window.freshness = (more) => dispatch("freshness", {connected: true, answered: true, fresh: true, age_s: 0,
    silence_s: 0, ...more});
  window.setpoints = [];
  const commands = {driving: async (_, {value}) => (setpoints.push(value), {tick: 100})};
  window.strip = new Strip(live);
  window.scope = new Scope(live, panel);
  window.drive = new Drive(live, {tell() {}});
  window.configuration = new Configuration(panel);
  window.reference = new Reference(live, panel, configuration, commands, () => {});
  window.xy = new Xy(live, panel);
  window.spectrum = new Spectrum(live, panel);
  window.recordings = new Recordings(scope);
  showDigits(live, panel, configuration);
  showEvents(live);
}"""
"""Script that creates the modules; `dispatch` simulates a message of the server, `setpoints` has all that were sent."""

Y = {"name": "y", "limits": {"command_um": 25, "drive_min_v": 0}}
"""Configuration of axis y, whose limits differ from the defaults."""


@contextmanager
def open_parts_page(browser: Any, folder: Path) -> Iterator[Any]:
    """Yield the page with its modules, served from `folder`, whose files such as `api/configuration` are the API."""
    (folder / "page").symlink_to(PAGE)
    (folder / "api").mkdir()
    write_configuration(folder, {"name": "x"}, Y)
    scriptless = (PAGE / "index.html").read_text(encoding="utf-8").replace('src="/page/main.js"', "")
    (folder / "index.html").write_text(scriptless, encoding="utf-8")
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    page = browser.new_page()
    page.set_default_timeout(1000 * TIMEOUT_S)
    page.goto(f"http://127.0.0.1:{server.server_address[1]}/")
    page.evaluate(SET_UP)
    yield page
    page.close()
    server.shutdown()
    server.server_close()


def write_configuration(folder: Path, *axes: dict[str, Any]) -> None:
    """Write the configuration of these axes, which the page reads the next time."""
    (folder / "api" / "configuration").write_text(json.dumps({"values": {"axis": axes}}))


def choose(parts: Any, picker: str, text: str) -> None:
    """Choose the entry `text` of a picker by mouse."""
    parts.click(f"#{picker} button")
    parts.click(f"#{picker}-list li:text-is('{text}')")


def await_exact_text(parts: Any, selector: str, text: str) -> None:
    """Wait until the whole text of an element is `text`."""
    await_text(parts, selector, f"^{re.escape(text)}$")
