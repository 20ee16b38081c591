// Numbers: parsed as people type them, formatted as an instrument shows them.

/** A number from "-5", "+5", "−5", "12,5" or "12.5"; raises Error in the panel's words. */
export function parseNumber(text, what = "this") {
  const plain = text.trim().replace(/^[−–]/, "-").replace(",", ".");
  if (!/^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i.test(plain) || !Number.isFinite(Number(plain))) {
    throw new Error(`${what}: “${text.trim()}” is no number; allowed: numbers such as 12.5, 12,5, -5 and +5`);
  }
  return Number(plain);
}

/** As `parseNumber`, out of a field; the field is marked, and gets the focus, where it holds none. */
export function fromField(field) {
  try {
    const value = parseNumber(field.value, field.labels?.[0]?.dataset.name ?? field.labels?.[0]?.textContent.trim());
    field.removeAttribute("aria-invalid");
    return value;
  } catch (error) {
    field.setAttribute("aria-invalid", "true");
    field.focus();
    throw error;
  }
}

/** With a true minus, so that digits keep their places. */
export function fixed(value, decimals) {
  if (value == null || !Number.isFinite(value)) return "—";
  const text = value.toFixed(decimals);
  return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "−");
}

/** So many significant digits, never in the form 1e-5 between 0.0001 and 10 million. */
export function significant(value, digits = 4) {
  if (value == null || !Number.isFinite(value)) return "—";
  if (value === 0) return "0";
  const power = Math.floor(Math.log10(Math.abs(value)));
  if (power < -5 || power > 7) return value.toExponential(digits - 1).replace(/-/g, "−");
  return fixed(value, Math.max(0, digits - 1 - power));
}

/** Decimals that a quantity of a unit is shown with, where it is measured. */
export const DECIMALS = { "µm": 3, V: 3, "µs": 1, nm: 1, "1": 0, ns: 0 };
const COUNTS = 2e4; // of the last decimal, at least, in a stroke
const [FEWEST, MOST] = [3, 7];

/** Show micrometres with as many decimals as a stroke in µm needs: three for 80, five for 0.2. */
export function suitStroke(stroke_um) {
  DECIMALS["µm"] = Math.min(Math.max(Math.ceil(Math.log10(COUNTS / stroke_um) - 1e-9), FEWEST), MOST);
}

/** The smallest span of a quantity that a plot is drawn over: so many of its last decimal. */
export const leastSpan = (unit, count = 20) => (DECIMALS[unit] ? count * 10 ** -DECIMALS[unit] : 0.5);

export function quantity(value, unit) {
  return fixed(value, DECIMALS[unit] ?? 3);
}

/** A duration with the unit that suits it. */
export function duration(seconds, digits = 4) {
  if (!Number.isFinite(seconds)) return "—";
  const size = Math.abs(seconds);
  if (size >= 1 || size === 0) return `${significant(seconds, digits)} s`;
  if (size >= 1e-3) return `${significant(seconds * 1e3, digits)} ms`;
  return `${significant(seconds * 1e6, digits)} µs`;
}

export function frequency(hz, digits = 4) {
  if (!Number.isFinite(hz)) return "—";
  return Math.abs(hz) >= 1000 ? `${significant(hz / 1000, digits)} kHz` : `${significant(hz, digits)} Hz`;
}

const LARGE = new Intl.NumberFormat("en", { maximumFractionDigits: 0 });
export const counted = (value) => (value == null ? "—" : LARGE.format(value).replace(/,/g, "\u202f"));

/** Like 3.2 MB. */
export function bytes(count) {
  return count >= 1e6 ? `${fixed(count / 1e6, 1)} MB` : `${fixed(count / 1e3, 1)} kB`;
}
