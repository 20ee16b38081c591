// The token moves from the address to the server, for a cookie, and leaves the address at once.

import { post } from "./api.js";
import { $, complain } from "./dom.js";

/**
 * What the loop is, once there is one and a session: by the token of the address, the cookie of before, or a token that
 * is typed. `opened` is called as soon as there is a session, whether or not a service answers.
 */
export async function openSession(get, opened) {
  const token = new URLSearchParams(location.hash.slice(1)).get("token");
  if (location.hash) history.replaceState(null, "", location.pathname);
  if (token) await post("/session", { token }).catch(() => {});
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
      const token = $("token").value.trim().replace(/^.*#token=/, "");
      try {
        await post("/session", { token });
        $("token").value = "";
        complain($("token-error"), null);
        dialog.close();
        resolve();
      } catch (error) {
        complain($("token-error"), error.status === 401 ? "This is not the token of the running panel. `rtloop panel` prints the token at each start." : error);
      }
    };
  });
}
