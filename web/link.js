// The status stream and its age: what was heard, when, and whether it still counts.
export const STALE_MS = 500;
const RATE_HZ = 15;
const RETRY_MS = 700;
const CLOCKS_MS = 60_000;

export class Link {
  /** `onStatus(status)` for each that counts; `onAge(ms or null, stale)` ten times a second; `onRefused()` once nobody is logged in. */
  constructor({ onStatus, onAge, onRefused }) {
    Object.assign(this, { onStatus, onAge, onRefused });
    this.heard_ms = null;
    this.delays = [];
    setInterval(() => this.tell(), 100);
  }

  open() {
    if (this.socket || document.hidden) return;
    const socket = (this.socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/v1/stream?rate_hz=${RATE_HZ}`));
    socket.onmessage = (event) => this.take(JSON.parse(event.data));
    socket.onclose = () => {
      if (this.socket === socket) this.socket = null;
      setTimeout(() => this.probe(), RETRY_MS);
    };
  }

  close() {
    const socket = this.socket;
    this.socket = null;
    socket?.close();
  }

  /** A browser does not say why a WebSocket was refused; a request does. */
  async probe() {
    if (document.hidden) return;
    try {
      const answer = await fetch("/v1/session", { cache: "no-store" });
      if (answer.status === 401) return this.onRefused();
    } catch { /* nobody answers: that is what the age tells */ }
    this.open();
  }

  /** What lay about on its way counts from when it was sent: the daemon's clock against ours, at their nearest. */
  take(status) {
    const now_ms = performance.now(), ahead_ms = now_ms - status.time_s * 1000;
    this.delays = this.delays.filter(([at_ms]) => now_ms - at_ms < CLOCKS_MS);
    const last = this.delays.at(-1);
    if (!last || now_ms - last[0] > 1000) this.delays.push([now_ms, ahead_ms]);
    else last[1] = Math.min(last[1], ahead_ms);
    const nearest_ms = Math.min(...this.delays.map(([, ms]) => ms));
    this.heard_ms = now_ms - (ahead_ms - nearest_ms);
    if (!this.stale) this.onStatus(status);
    this.tell();
  }

  get age_ms() { return this.heard_ms === null ? null : performance.now() - this.heard_ms; }
  get stale() { return this.age_ms === null || this.age_ms > STALE_MS; }
  tell() { this.onAge(this.age_ms, this.stale); }
}

/** A request; `{ok, ...answer}`, or `{ok: false, error, remedy}` whatever went wrong. Nothing is sent twice. */
export async function ask(method, path, body, headers = {}) {
  try {
    const answer = await fetch(path, { method, cache: "no-store", headers: { "Content-Type": "application/json", ...headers }, body: body && JSON.stringify(body), signal: AbortSignal.timeout(4000) });
    return { ok: answer.ok, status: answer.status, ...(answer.status === 204 ? {} : await answer.json()) };
  } catch (error) {
    return { ok: false, status: 0, error: String(error.message || error), remedy: "" };
  }
}
