// The recordings: a summary of each, its plot, its download, and a sweep from it behind the scope.

import { get, getArrays, getBlob, post } from "../api.js";
import { $, complain, make, say } from "../dom.js";
import { bytes, counted, duration, fromField, significant } from "../numbers.js";

const address = (file, what = "") => `/api/recordings/${encodeURIComponent(file)}${what}`;

export class Recordings {
  #scope;
  #shown = null;

  constructor(scope) {
    this.#scope = scope;
    $("reread").addEventListener("click", () => this.open());
  }

  canvases = [];

  async open() {
    $("reread").setAttribute("aria-busy", "true");
    say($("reread"), "Reading…");
    try {
      const list = await get("/api/recordings");
      list.sort((a, b) => b.begins_unix_s - a.begins_unix_s);
      $("recording-list").tBodies[0].replaceChildren(...list.map((one) => this.#row(one)));
      complain($("recordings-error"), list.length ? null : "The folder has no recordings yet.");
    } catch (error) {
      complain($("recordings-error"), error);
    }
    $("reread").removeAttribute("aria-busy");
    say($("reread"), "Refresh list");
  }

  close() {}

  arrange() {}

  #row(recording) {
    const { file, complete, duration_s, bytes: size, begins_unix_s, trips, captured, around } = recording;
    const begins = begins_unix_s ? new Date(begins_unix_s * 1000).toLocaleString("sv") : "—";
    const act = (text, action) => make("button", { type: "button", "aria-label": `${text} of ${file}`, click: () => this.#try(action) }, text);
    return make("tr", { "aria-current": this.#shown === file && "true" },
      make("th", { scope: "row" }, file),
      make("td", {}, begins), make("td", {}, duration_s == null ? "—" : duration(duration_s, 3)), make("td", {}, bytes(size)),
      make("td", { class: "trips" }, trips == null ? "—" : String(trips)),
      make("td", {}, [captured && "captured", around && "around events", file.endsWith(".part") ? "not finished" : complete === false && "incomplete"].filter(Boolean).join(", ")),
      make("td", {}, make("span", { class: "bar" },
        act("Info", () => this.#info(file)),
        act("Plot", () => this.#plot(file)),
        act("Compare", () => this.#offer(recording)),
        act("Download", () => this.#download(file)))));
  }

  async #try(action) {
    try {
      complain($("recordings-error"), null);
      await action();
    } catch (error) {
      complain($("recordings-error"), error);
    }
  }

  #show(file, ...content) {
    this.#mark(file);
    $("recording-shown").hidden = false;
    const close = make("button", { type: "button", click: () => this.#close() }, "Close");
    $("recording-shown").replaceChildren(make("div", { class: "bar" }, make("b", {}, file), make("span", { class: "gap" }), close), ...content);
    $("recording-shown").scrollIntoView({ block: "nearest" });
  }

  #close() {
    this.#mark(null);
    $("recording-shown").hidden = true;
  }

  /** Mark the row of the recording that is shown. */
  #mark(file) {
    this.#shown = file;
    for (const row of $("recording-list").tBodies[0].rows) {
      if (row.cells[0].textContent === file) row.setAttribute("aria-current", "true");
      else row.removeAttribute("aria-current");
    }
  }

  /** Show that a recording is being read; returns the note. */
  #wait(file) {
    const note = make("p", { class: "note", role: "status" }, "Reading the recording…");
    this.#show(file, note);
    return note;
  }

  async #info(file) {
    const note = this.#wait(file);
    const info = await get(address(file, "/info")).catch((error) => {
      if (note.isConnected) this.#close();
      throw error;
    });
    if (!note.isConnected) return; // another one was asked for meanwhile
    const rows = Object.entries(flat(info));
    this.#show(file, make("table", { class: "numbers" }, make("tbody", {}, ...rows.map(([key, value]) => make("tr", {}, make("th", { scope: "row" }, key), make("td", {}, value))))));
  }

  async #plot(file) {
    const note = this.#wait(file);
    try {
      const picture = make("img", { src: URL.createObjectURL(await getBlob(address(file, "/plot.png"))), alt: `Plot of ${file}: its signals over time` });
      picture.addEventListener("load", () => URL.revokeObjectURL(picture.src));
      note.replaceWith(picture);
    } catch (error) {
      if (!note.isConnected) return;
      this.#close();
      throw error;
    }
  }

  /** The browser itself downloads, however large the file is; it sends no header, so that the path admits it once. */
  async #download(file) {
    const { path } = await post(address(file, "/ticket"));
    make("a", { href: path, download: file.replace(/\.part$/, "") }).click();
  }

  /** Where in the recording the sweep begins is asked for; from there as long as the scope's screen. */
  async #offer(recording) {
    const from = make("input", { value: "0", size: 8, id: "compare-from" });
    const error = make("output", { class: "error", role: "alert" });
    const form = make("form", { class: "bar", autocomplete: "off" }, make("label", { class: "field", "data-name": "From" }, "from ", from, " s on, as long as the scope's screen"), make("button", { type: "submit", class: "prime" }, "Compare"), error);
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      try {
        await this.#compare(recording, fromField(from));
        complain(error, null);
      } catch (failure) {
        complain(error, failure);
      }
    });
    this.#show(recording.file, form);
    from.focus();
  }

  async #compare({ file, ticks: held, cut }, from_s) {
    const { signals, seconds, trigger } = this.#scope.view;
    const asked = `/sweep?signals=${signals}&pixels=${this.#scope.pixels}`;
    const { first: begin, rate_hz } = await getArrays(address(file, `${asked}&ticks=1`));
    const first = begin + Math.round(from_s * rate_hz);
    const end = cut?.end ?? (held == null ? Infinity : begin + held);
    const ticks = Math.max(1, Math.min(Math.round(seconds * rate_hz), end - first));
    const sweep = await getArrays(address(file, `${asked}&first=${first}&ticks=${ticks}`));
    const before = trigger.mode === "roll" ? ticks : (ticks * trigger.pre_percent) / 100;
    const begins = sweep.arrays.offset[0] ?? 0;
    sweep.arrays.offset = sweep.arrays.offset.map((offset) => offset - begins - before);
    this.#scope.compare(sweep, `The faded traces are ${file}, from ${duration(from_s)} on (tick ${counted(first)}).`);
  }
}

/** Nested values as "a.b": text; long lists by their length. */
function flat(value, path = "", found = {}) {
  if (Array.isArray(value) && value.length > 8) found[path] = `${value.length} values`;
  else if (value && typeof value === "object") for (const [key, item] of Object.entries(value)) flat(item, path ? `${path}.${key}` : key, found);
  else if (typeof value === "number") found[path] = Number.isInteger(value) ? counted(value) : significant(value, 6);
  else found[path] = value == null ? "—" : String(value);
  return found;
}
