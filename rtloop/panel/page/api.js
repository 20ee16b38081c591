// Requests to the panel's server, which forwards commands to the service.

import { decode } from "./message.js";
import { forgetProof, sessionSecret } from "./session.js";

/** What the service, or the server, said against a request; `status` is 0 where nobody answered. */
export class Refusal extends Error {
  constructor(status, text) {
    super(text);
    this.status = status;
  }
}

/** Who drives here; kept by this browser. */
export const who = {
  get name() {
    return localStorage.getItem("rtloop-name") ?? "";
  },
  set name(name) {
    localStorage.setItem("rtloop-name", name.trim());
  },
};

async function ask(path, options = {}) {
  let response;
  try {
    const secret = await sessionSecret();
    const headers = { ...options.headers, ...(secret && { Authorization: `Bearer ${secret}` }) };
    response = await fetch(path, { cache: "no-store", credentials: "omit", ...options, headers });
  } catch {
    forgetProof();
    throw new Refusal(0, "the panel's server does not answer, and the command may have had no effect");
  }
  if (response.ok) return response;
  const text = await response.text();
  let said = text;
  try {
    const answer = JSON.parse(text);
    said = answer.error ?? answer.detail ?? text;
  } catch {
    // A plain text is the message itself.
  }
  if (response.status === 401) dispatchEvent(new Event("rtloop-session-lost"));
  throw new Refusal(response.status, String(said || `refused with ${response.status}`));
}

const posted = (body) => ({
  method: "POST",
  headers: { "Content-Type": "application/json" },
  body: JSON.stringify(body),
});

const named = (path) => (who.name ? `${path}?as=${encodeURIComponent(who.name)}` : path);

export const get = async (path) => (await ask(path)).json();

export const post = async (path, body = {}, options = {}) => {
  const response = await ask(path, { ...posted(body), ...options });
  return response.status === 204 ? {} : response.json();
};

export const getBlob = async (path) => (await ask(path)).blob();

/** Arrays by name, as over the WebSocket. */
export const getArrays = async (path) => decode(await (await ask(path)).arrayBuffer());

/** A command under the name of who drives; returns what the service answers. Raises Refusal. */
export const command = (name, body, options) => post(named(`/api/${name}`), body, options);

export const releaseLock = async () => (await ask(named("/api/lock"), { method: "DELETE" })).json();

/** STOP is asked for again until somebody answers, for five seconds; `report` hears of each failure. */
export async function stop(report) {
  const until_ms = performance.now() + 5000;
  for (;;) {
    try {
      return await (await ask(named("/api/stop"), { ...posted({}), keepalive: true })).json();
    } catch (error) {
      report(error);
      if (performance.now() > until_ms || (error.status >= 400 && error.status < 500)) throw error;
      await new Promise((resolve) => setTimeout(resolve, 200));
    }
  }
}
