// The session: its secret goes into a header of each request. It is no cookie, which every port of the host would receive.
//
// It is sent to the panel alone that gave it: after each break the server must prove that it knows the secret, because
// another user's server may listen at the same address, at the end of a broken tunnel.

import { $, complain } from "./dom.js";

const STORED = "rtloop-session";
const ASK = "ask";
const OTHER_TAB_MS = 300;
const bytes = (text) => new TextEncoder().encode(text);
const tabs = new BroadcastChannel(STORED);

let secret = sessionStorage.getItem(STORED);
let proven = null; // promise of the secret, once a proof was asked for; null since the last break

tabs.addEventListener("message", async ({ data }) => {
  const known = data === ASK && (await proven?.catch(() => null));
  if (known) tabs.postMessage(known);
});

/** The secret for a request, or null without a session. Raises TypeError where no server answers. */
export function sessionSecret() {
  if (!secret) return null;
  proven ??= prove().catch((error) => {
    forgetProof();
    throw error;
  });
  return proven;
}

/** A connection broke: another server may answer from now on. */
export function forgetProof() {
  proven = null;
  sessionStorage.removeItem(STORED); // a page that is loaded from now on may be another server's
}

async function prove() {
  const nonce = crypto.randomUUID();
  const response = await fetch(`/session?nonce=${nonce}`, { cache: "no-store", credentials: "omit" });
  const { proof } = response.ok ? await response.json() : {};
  const key = await crypto.subtle.importKey("raw", bytes(secret), { name: "HMAC", hash: "SHA-256" }, false, ["sign"]);
  const expected = new Uint8Array(await crypto.subtle.sign("HMAC", key, bytes(nonce)));
  if (proof === [...expected].map((byte) => byte.toString(16).padStart(2, "0")).join("")) sessionStorage.setItem(STORED, secret);
  else secret = null; // another panel, for which there is another token
  return secret;
}

/** Exchange the token for the session. Returns null, or the reason of a refusal. */
async function logIn(token) {
  const options = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ token }), cache: "no-store", credentials: "omit" };
  const response = await fetch("/session", options);
  const answer = await response.json();
  if (response.status === 401) return "This is not the token of the running panel. `rtloop panel` prints the token at each start.";
  if (!response.ok) return answer.error;
  secret = answer.session;
  sessionStorage.setItem(STORED, secret);
  proven = Promise.resolve(secret);
  return null;
}

/** Take over the session of another tab, if one is open. */
const askOtherTabs = () =>
  new Promise((resolve) => {
    tabs.addEventListener("message", ({ data }) => {
      if (data === ASK) return;
      secret ??= data;
      resolve();
    });
    tabs.postMessage(ASK);
    setTimeout(resolve, OTHER_TAB_MS);
  });

/**
 * What the loop is, once there is one and a session: by the token of the address, the session of this tab or another
 * one, or a token that is typed. `opened` is called as soon as there is a session, whether or not a service answers.
 */
export async function openSession(get, opened) {
  const token = new URLSearchParams(location.hash.slice(1)).get("token");
  if (location.hash) history.replaceState(null, "", location.pathname);
  addEventListener("hashchange", () => location.hash.startsWith("#token=") && location.reload()); // the address, opened in this tab again
  if (token) await logIn(token).catch(() => {});
  else if (!secret) await askOtherTabs();
  for (;;) {
    try {
      return await get("/api/panel");
    } catch (error) {
      if (error.status === 401) {
        await askForToken();
        continue;
      }
      if (error.status === 503) opened();
      await new Promise((resolve) => setTimeout(resolve, 1000));
    }
  }
}

/** Asks until a token is right. */
export function askForToken() {
  const dialog = $("token-dialog");
  if (dialog.open) return new Promise((resolve) => dialog.addEventListener("close", resolve, { once: true }));
  dialog.showModal();
  dialog.oncancel = (event) => event.preventDefault();
  return new Promise((resolve) => {
    $("token-form").onsubmit = async (event) => {
      event.preventDefault();
      const refusal = await logIn($("token").value.trim().replace(/^.*#token=/, "")).catch((error) => error);
      complain($("token-error"), refusal);
      if (refusal) return;
      $("token").value = "";
      dialog.close();
      resolve();
    };
  });
}
