// Votes and drawings on their way: kept by this browser until the station has each of them; votes are sent one by one in the order they were given.

import { post, siteUrl } from "./api.js";
import { KeptList } from "./choices.js";

const KEPT = "sorvolo-votes";
const LONGEST_WAIT_MS = 15000;
const REFUSED = new Set([400, 403, 404, 409, 410, 413, 422]); // by the station, for good; all else is tried again

/** Fires `change` where a vote came or went, `taken` (detail: {vote, answer}), `refused` (detail: {vote, problem}). */
class Votes extends EventTarget {
  constructor() {
    super();
    this.who = null; // who is logged in: votes of another person wait for that person
    this.wait_ms = 500;
    this.kept = new KeptList(KEPT);
    addEventListener("online", () => this.send());
    addEventListener("storage", ({ key }) => { if (key === KEPT) this.changed(); });
  }

  /** All votes that the station does not have yet, the oldest first; those of other tabs, too. */
  get waiting() {
    return this.kept.all;
  }

  keep(list) {
    this.kept.keep(list);
    this.changed();
  }

  changed() {
    this.dispatchEvent(new Event("change"));
  }

  add(vote) {
    const number = `${Date.now()} ${Math.random()}`;
    this.keep([...this.waiting, { ...vote, who: this.who, number, at: new Date().toISOString() }]);
    this.send();
  }

  /** Votes of whom the page belongs to now. */
  get mine() {
    return this.waiting.filter((each) => each.who === this.who);
  }

  /** Send what waits; where several tabs could, one does. */
  async send() {
    if (this.sending || this.who === null) return;
    clearTimeout(this.timer);
    this.sending = true;
    try {
      do await (navigator.locks ? navigator.locks.request(KEPT, () => this.sendAll()) : this.sendAll());
      while (this.mine.length); // one was given just when the last was taken
    } catch {
      this.timer = setTimeout(() => this.send(), this.wait_ms);
      this.wait_ms = Math.min(this.wait_ms * 1.7, LONGEST_WAIT_MS);
    } finally { this.sending = false; }
  }

  async sendAll() {
    for (let vote = this.mine[0]; vote; vote = this.mine[0]) {
      const { site, kind, id, verdict, note, number } = vote;
      const drop = () => this.keep(this.waiting.filter((each) => each.number !== number));
      try {
        const answer = await post(siteUrl(site, "reviews"), { kind, id, verdict, note });
        drop();
        this.wait_ms = 500;
        this.dispatchEvent(new CustomEvent("taken", { detail: { vote, answer } }));
      } catch (problem) {
        if (!REFUSED.has(problem.status)) throw problem;
        drop();
        this.dispatchEvent(new CustomEvent("refused", { detail: { vote, problem } }));
      }
    }
  }
}

export const votes = new Votes();

/** New drawings that the station does not have yet: {site, who, feature}. */
export const unsent = new KeptList("sorvolo-drawings");
