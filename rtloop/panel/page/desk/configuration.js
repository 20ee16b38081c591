// The running configuration of the axes with all changes; an event "read" announces a new one.

import { get } from "../api.js";
import { suitStroke } from "../numbers.js";

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
    suitStroke(Math.min(...this.#axes.map(({ name }) => this.limits(name).stroke_um)));
    this.dispatchEvent(new Event("read"));
  }

  /** Of an axis; a controller is that of the axis which it shares one with, where it has none of its own. */
  section(name, section) {
    const own = this.#axes.find((axis) => axis.name === name)?.[section];
    const shared = section === "controller" && this.#axes.find(({ controller }) => controller?.axes?.includes(name))?.controller;
    return { ...this.#defaults[section], ...(own ?? (shared || {})) };
  }

  /**
   * In µm up and down, with the name of the limit that binds, in V, and the stroke in µm between them: that of the
   * feedforward's model where it is shorter.
   */
  limits(name) {
    const { drive_v = 10, drive_min_v, command_um = 40 } = this.section(name, "limits");
    const { position_um = 40 } = this.section(name, "interlocks");
    const [lowest_v, highest_v] = [drive_min_v ?? -drive_v, drive_v];
    const ends_um = [lowest_v, highest_v].map((volts) => this.#position(name, volts));
    const drive_um = Math.max(...ends_um.map(Math.abs)) || Infinity;
    const bounds = [[command_um, "limits.command_um"], [position_um, "interlocks.position_um"], [drive_um, "limits.drive_v"]];
    const [most_um, bound] = bounds.reduce((least, other) => (other[0] < least[0] ? other : least));
    const stroke_um = Math.min(2 * most_um, Math.abs(ends_um[1] - ends_um[0]) || Infinity);
    return { most_um, bound, lowest_v, highest_v, stroke_um };
  }

  /** The position in µm at which the feedforward's plays hold the actuator, from rest, at a drive; 0 without plays. */
  #position(name, volts) {
    const { weights_um_per_v = [], thresholds_v = [] } = this.section(name, "feedforward");
    const pull = (weight, play) => weight * Math.max(Math.abs(volts) - (thresholds_v[play] ?? 0), 0);
    return Math.sign(volts) * weights_um_per_v.reduce((sum, weight, play) => sum + pull(weight, play), 0);
  }
}
