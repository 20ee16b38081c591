// What the axes are configured for as they run, with what was tuned since: whoever shows it hears "read".

import { get } from "../api.js";

export class Configuration extends EventTarget {
  #defaults;
  #axes = [];

  /** `defaults` are what sections hold where nothing else is said. */
  constructor({ defaults }) {
    super();
    this.#defaults = defaults ?? {};
  }

  /** Raises what the service refuses with. */
  async read() {
    const { values } = await get("/api/configuration");
    this.#axes = values.axis;
    this.dispatchEvent(new Event("read"));
  }

  /** Of an axis; a controller is that of the axis which it shares one with, where it has none of its own. */
  section(name, section) {
    const own = this.#axes.find((axis) => axis.name === name)?.[section];
    const shared = section === "controller" && this.#axes.find(({ controller }) => controller?.axes?.includes(name))?.controller;
    return { ...this.#defaults[section], ...(own ?? (shared || {})) };
  }

  /** In µm up and down, and in V. */
  limits(name) {
    const { drive_v = 10, drive_min_v, command_um = 40 } = this.section(name, "limits");
    const { position_um = 40 } = this.section(name, "interlocks");
    return { most_um: Math.min(command_um, position_um), lowest_v: drive_min_v ?? -drive_v, highest_v: drive_v };
  }
}
