// The WebSocket: messages become events by kind; subscriptions are kept and sent again after a break.

import { get } from "./api.js";
import { decode } from "./message.js";
import { forgetProof, sessionSecret } from "./session.js";

const SILENCE_MS = 600;
/** State comes 20 times a second; without any for so long, what is shown is not the present. */
const WATCH_MS = 100;
const GONE_WATCHES = 30;
/** Without any state in so many watches, the service counts as gone. Not a time: a page that was itself held up heard nothing. */
const AGAIN_MS = [250, 500, 1000, 2000];

export class Live extends EventTarget {
  #socket = null;
  #connecting = false;
  #wishes = {};
  #failures = 0;
  #heard_ms = -Infinity;
  #watches = 0; // since then
  #age_s = null;
  #answered = false;

  constructor() {
    super();
    setInterval(() => {
      this.#watches++;
      this.#watch();
    }, WATCH_MS);
  }

  /** Once is enough: it comes again by itself. */
  connect() {
    if (this.#connecting) return;
    this.#connecting = true;
    this.#open();
  }

  async #open() {
    const secret = await Promise.resolve(sessionSecret()).catch(() => null);
    if (!secret) return this.#again();
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/live`, ["rtloop", `rtloop.session.${secret}`]);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.#failures = 0;
      if (Object.keys(this.#wishes).length) socket.send(JSON.stringify(this.#wishes));
    };
    socket.onmessage = ({ data }) => this.#take(decode(data));
    socket.onclose = () => {
      this.#socket = null;
      this.#watch();
      this.#again();
    };
    this.#socket = socket;
  }

  #again() {
    forgetProof();
    get("/api/panel").catch(() => {}); // says by itself where the session is over
    setTimeout(() => this.#open(), AGAIN_MS[Math.min(this.#failures++, AGAIN_MS.length - 1)]);
  }

  /** What is wanted from now on, by key. */
  wish(wishes) {
    Object.assign(this.#wishes, wishes);
    this.once(wishes);
  }

  /** What is wanted one time. */
  once(wishes) {
    if (this.#socket?.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify(wishes));
  }

  #take(message) {
    if (message.kind === "state") {
      this.#heard_ms = performance.now();
      this.#watches = 0;
      this.#age_s = message.age_s;
      this.#answered = message.state !== "unreachable";
      this.#watch();
    }
    this.dispatchEvent(new CustomEvent(message.kind, { detail: message }));
  }

  /** Tells how old what is shown is, whether it is the present, and whether the service answers. */
  #watch() {
    const silence_ms = performance.now() - this.#heard_ms;
    const connected = this.#socket?.readyState === WebSocket.OPEN && silence_ms < SILENCE_MS;
    const age_s = this.#age_s == null ? null : this.#age_s + (connected ? 0 : silence_ms / 1000);
    const fresh = connected && this.#answered && age_s != null && age_s * 1000 < SILENCE_MS;
    const detail = { connected, answered: this.#answered && this.#watches < GONE_WATCHES, fresh, age_s, silence_s: silence_ms / 1000 };
    this.dispatchEvent(new CustomEvent("freshness", { detail }));
  }
}
