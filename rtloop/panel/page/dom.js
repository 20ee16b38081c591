// Elements: functions that find, make and fill them.

export const $ = (id) => document.getElementById(id);

/** An element with attributes (a function is a listener, false and null leave one out) and children. */
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") element.addEventListener(name, value);
    else if (value !== false && value != null) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child != null));
  return element;
}

/** Set a text only where it differs: a screen reader and the layout see changes alone. */
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Show what went wrong next to where it was asked for; nothing is said where `error` is missing. */
export function complain(element, error) {
  say(element, error ? error.message ?? String(error) : "");
}

/** Call `action` at most every `least_ms`, the last time with the last arguments. */
export function calmly(least_ms, action) {
  let timer = null;
  let last_ms = -Infinity;
  return (...given) => {
    clearTimeout(timer);
    const wait_ms = Math.max(0, last_ms + least_ms - performance.now());
    timer = setTimeout(() => {
      last_ms = performance.now();
      action(...given);
    }, wait_ms);
  };
}

export const reducedMotion = matchMedia("(prefers-reduced-motion: reduce)");
