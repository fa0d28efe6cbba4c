// Moving by hand: motion lasts while a finger is known to be down, the page seen and the daemon heard.
import { STALE_MS } from "./link.js";

const RENEW_MS = 100;
const UNSENT_MS = 200;

export class Hold {
  /** `link`: tells whether the daemon is heard. `say(...keys or texts)`: what became of it. */
  constructor(link, say) {
    this.link = link;
    this.say = say;
    this.held = null;
    this.timer = null;
    const end = () => this.end("released");
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) addEventListener(name, (event) => { if (this.held && event.pointerId === this.held.pointer) end(); }, true);
    // A second finger, or another button of the mouse: nobody knows which of them is meant.
    addEventListener("pointerdown", (event) => {
      if (!this.held) return;
      end();
      if (!event.target.closest?.("#stop")) event.stopImmediatePropagation();
    }, true);
    addEventListener("keydown", (event) => { if (this.held && !(event.key === "Enter" && event.repeat)) end(); }, true);
    addEventListener("keyup", () => { if (this.held?.pointer === "key") end(); }, true);
    addEventListener("blur", end);
    for (const name of ["pagehide", "beforeunload"]) addEventListener(name, () => this.close());
    for (const name of ["visibilitychange", "freeze"]) document.addEventListener(name, () => { if (name === "freeze" || document.hidden) this.close(); });
  }

  open() {
    if (this.socket || document.hidden) return;
    const socket = (this.socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/v1/jog?client=page`));
    socket.onmessage = (event) => this.answered(JSON.parse(event.data));
    socket.onclose = () => {
      if (this.socket !== socket) return;
      this.socket = null;
      if (this.held) this.end("lost");
    };
  }

  close() {
    this.end("released");
    const socket = this.socket;
    this.socket = null;
    socket?.close();
  }

  /** Make `button` one that moves while it is held. `motion()`: the command, or null where there is none now. It is sent
   * once: a lease that has lapsed is not taken again by a hand that has not moved. */
  attach(button, motion) {
    button.addEventListener("pointerdown", (event) => {
      if (!event.isTrusted || !event.isPrimary || event.button !== 0 || this.held) return;
      event.preventDefault();
      button.focus({ preventScroll: true });
      button.setPointerCapture(event.pointerId);
      this.begin(button, motion(), event.pointerId);
    });
    button.addEventListener("keydown", (event) => {
      if (event.key !== "Enter") return;
      event.preventDefault();
      if (event.isTrusted && !event.repeat && !this.held) this.begin(button, motion(), "key");
    });
    button.addEventListener("blur", () => { if (this.held?.button === button) this.end("released"); });
    button.addEventListener("click", (event) => event.preventDefault());
    button.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  begin(button, motion, pointer) {
    if (!motion || button.disabled || this.link.stale) return;
    this.open();
    if (this.socket?.readyState !== WebSocket.OPEN) { this.say("connecting"); return; }
    this.held = { button, pointer, unsent_ms: null, waits: 0 };
    button.dataset.held = "";
    this.say("jogging");
    this.send(motion);
    this.timer = setInterval(() => this.renew(), RENEW_MS);
  }

  renew() {
    const held = this.held, now_ms = performance.now();
    if (!held) return;
    if (!held.button.isConnected || held.button.disabled || this.link.age_ms > STALE_MS) return this.end("lost");
    // What is not sent yet would arrive late, when the hand may be gone.
    if (this.socket.bufferedAmount === 0) held.unsent_ms = null;
    else if (now_ms - (held.unsent_ms ??= now_ms) > UNSENT_MS) { this.end("lost"); this.close(); return; }
    else return;
    if (held.waits > 3) return; // unanswered: the lease lapses by itself
    this.send({ command: "renew" });
  }

  send(message) {
    if (this.socket?.readyState !== WebSocket.OPEN) return;
    if (this.held) this.held.waits += 1;
    this.socket.send(JSON.stringify(message));
  }

  answered(reply) {
    const held = this.held;
    if (!held) return;
    held.waits = Math.max(0, held.waits - 1);
    if (reply.accepted) return;
    this.end(...((reply.where || reply.command) === "renew" ? ["lapsed"] : [reply.error || reply.message, reply.remedy]));
  }

  /** Let go: said to the daemon at once; what cannot be said ends by its lease. */
  end(...why) {
    const held = this.held;
    if (!held) return;
    this.held = null;
    clearInterval(this.timer);
    delete held.button.dataset.held;
    this.send({ command: "release" });
    this.say(...why);
  }
}
