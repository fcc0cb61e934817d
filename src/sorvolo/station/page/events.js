// Live events: one WebSocket that comes back by itself and asks from the last number that it saw.

import { socketTo } from "./api.js";

const QUIET_MS = 40000; // the station sends a sign of life every 15 s
const LONGEST_WAIT_MS = 15000;

/**
 * The station's events as an EventTarget: `type` of each event and `*` for all (detail: the message), `state` (detail:
 * "live", "waiting" or "lost"). Events come once each and in order; `reload` asks to load everything anew.
 */
export class Events extends EventTarget {
  constructor(after) {
    super();
    this.seq = after;
    this.wait_ms = 500;
    this.socket = null;
    this.state = "waiting";
    this.connect();
    document.addEventListener("visibilitychange", () => this.wake());
    for (const type of ["online", "pageshow", "focus"]) addEventListener(type, () => this.wake());
  }

  connect() {
    clearTimeout(this.timer);
    const socket = this.socket = socketTo(`/api/events?after=${this.seq}`);
    this.begun_at = this.heard_at = Date.now();
    socket.addEventListener("open", () => this.set("live"));
    socket.addEventListener("message", (message) => this.hear(JSON.parse(message.data)));
    socket.addEventListener("close", () => { if (socket === this.socket) this.again(); });
    clearInterval(this.watch);
    this.watch = setInterval(() => this.look(), 5000);
  }

  /** After sleep a socket may look open and be dead: what was silent for too long is dropped. */
  look() {
    if (Date.now() - this.heard_at > QUIET_MS && this.socket) {
      this.drop();
      this.again();
    }
  }

  drop() {
    const old = this.socket;
    this.socket = null;
    old?.close();
  }

  again() {
    this.set(this.wait_ms > 4000 ? "lost" : "waiting");
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.connect(), this.wait_ms);
    this.wait_ms = Math.min(this.wait_ms * 1.7, LONGEST_WAIT_MS);
  }

  wake() {
    if (document.visibilityState !== "visible") return;
    this.look();
    if (this.state !== "live" && Date.now() - this.begun_at > 1000) {
      this.wait_ms = 500;
      this.drop();
      this.connect();
    }
  }

  hear(message) {
    this.heard_at = Date.now();
    this.wait_ms = 500;
    this.set("live");
    if (message.type === "alive") {
      if (message.seq < this.seq) this.restart(message.seq); // another station took the place of the first
      return;
    }
    if (message.type === "events.lost") return this.restart(message.seq ?? message.data?.to ?? this.seq);
    if (message.seq <= this.seq) return;
    this.seq = message.seq;
    for (const type of [message.type, "*"]) this.dispatchEvent(new CustomEvent(type, { detail: message }));
  }

  restart(seq) {
    this.seq = seq;
    this.dispatchEvent(new Event("reload"));
  }

  set(state) {
    if (state === this.state) return;
    this.state = state;
    this.dispatchEvent(new CustomEvent("state", { detail: state }));
  }
}
