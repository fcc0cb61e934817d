// The gallery: changes and objects one after another, large pictures, judged with the keyboard.

import { button, choice, el, fill, icon, tick } from "./dom.js";
import { badge, facts, isWritten, picture, pictures, titleOf } from "./feature_card.js";
import { counted } from "./words.js";
import { cropsOf, isChange } from "./site_data.js";
import { judge, verdictForm } from "./verdicts.js";

const ORDERS = {
  score: ["surest first", (one, other) => (other.properties.score ?? 0) - (one.properties.score ?? 0)],
  doubt: ["least sure first", (one, other) => (one.properties.score ?? 0) - (other.properties.score ?? 0)],
  size: ["largest first", (one, other) => (other.properties.area_m2 ?? other.properties.length_m ?? 0) - (one.properties.area_m2 ?? one.properties.length_m ?? 0)],
  time: ["newest first", (one, other) => String(other.properties.first_seen ?? "").localeCompare(String(one.properties.first_seen ?? ""))],
};

/** The panel's life: a strip of all, and the stage's large card. */
export function reviewPanel(screen, body) {
  return new Review(screen, body);
}

class Review {
  constructor(screen, body) {
    Object.assign(this, { screen, what: "changes", order: "score", open: false, at: null });
    if (!screen.data.all.changes.length && screen.data.all.objects.length) this.what = "objects";
    this.head = el("div", {});
    this.strip = el("ul", { class: "strip", "aria-label": "To review" });
    this.big = el("div", { class: "gallery" });
    screen.stage.append(this.big);
    fill(body, this.head, this.strip);
    screen.card.show(null);
    this.at = screen.data.chosen?.id ?? null;
    if (screen.data.chosen && !isChange(screen.data.chosen)) this.what = "objects";
    this.refresh();
  }

  shown(what = this.what) {
    return this.screen.data.shown(what);
  }

  list() {
    const shown = this.shown().filter((each) => !this.open || !each.properties.review || each.id === this.at);
    return [...shown].sort(ORDERS[this.order][1]);
  }

  refresh() {
    const list = this.list();
    if (!list.some((each) => each.id === this.at)) this.at = list[0]?.id ?? null;
    this.showHead(list);
    fill(this.strip, list.map((each) => this.item(each)));
    this.showBig(list);
  }

  showHead(list) {
    const all = this.shown();
    const done = all.filter((each) => each.properties.review).length;
    fill(this.head,
      el("div", { class: "segments", role: "group", "aria-label": "What to review" }, ["changes", "objects"].map((what) =>
        el("button", { type: "button", "aria-pressed": String(what === this.what), on: { click: () => { this.what = what; this.at = null; this.refresh(); } } },
          `${what === "changes" ? "Changes" : "Objects"} (${this.shown(what).length})`))),
      el("div", { class: "review-order" }, choice(Object.entries(ORDERS).map(([key, [words]]) => [key, words]), this.order,
        (order) => { this.order = order; this.refresh(); }, { "aria-label": "Order" }),
        tick("only open ones", this.open, (open) => { this.open = open; this.refresh(); })),
      all.length ? el("div", { class: "progress" }, el("progress", { max: all.length, value: done, "aria-label": "Reviewed" }), el("span", {}, `${done} of ${all.length} reviewed`)) : null,
      list.length ? null : el("p", { class: "hint" }, all.length ? "All reviewed. Untick “only open ones” to see them again." : `No ${this.what} to review${this.screen.data.all[this.what].length ? ": the filter hides them all" : ""}.`));
  }

  item(feature) {
    const chosen = feature.id === this.at;
    const words = { confirmed: "check", rejected: "cross" }[feature.properties.review];
    return el("li", {}, el("button", { type: "button", "aria-current": chosen ? "true" : null, data: { id: feature.id }, class: feature.properties.review ?? "open", on: { click: () => this.choose(feature.id) } },
      cropsOf(feature).length ? picture(cropsOf(feature).at(-1), "") : el("div", { class: "gone" }, "no picture yet"),
      el("span", { class: "name" }, badge(feature), titleOf(feature)),
      words ? el("span", { class: "mark" }, icon(words), el("span", { class: "sr" }, feature.properties.review)) : null));
  }

  showBig(list) {
    const at = list.findIndex((each) => each.id === this.at);
    this.big.hidden = at < 0;
    if (at < 0) return;
    if (isWritten(this.big) && this.drawn === this.at) return;
    this.drawn = this.at;
    const feature = list[at];
    this.pictures = pictures(feature);
    fill(this.big,
      el("div", { class: "gallery-head" }, badge(feature), el("h3", {}, titleOf(feature)), el("span", { class: "soft" }, `${at + 1} of ${list.length}`),
        button("Previous", () => this.step(-1), { class: "quiet", "aria-keyshortcuts": "K" }), button("Next", () => this.step(1), { class: "quiet", "aria-keyshortcuts": "J" })),
      this.pictures,
      el("div", { class: "gallery-foot" }, facts(feature, this.screen.data.detail.is_local),
        el("div", {}, verdictForm(this.screen, feature, { keys: true, given: (verdict, note) => this.give(verdict, note) }),
          el("div", { class: "row" }, button("Show on the map", () => this.map(), { icon: "target", "aria-keyshortcuts": "M" }),
            isChange(feature) ? button("Blink", () => this.blink(), { class: "quiet", "aria-keyshortcuts": "B" }) : null))));
    this.strip.querySelector("[aria-current]")?.scrollIntoView({ block: "nearest" });
  }

  blink() {
    this.pictures.classList.toggle("blinking");
  }

  map() {
    const feature = this.screen.data.find(this.at);
    this.screen.open("map");
    this.screen.data.choose(feature);
    this.screen.goTo(feature);
  }

  choose(id) {
    this.at = id;
    this.refresh();
  }

  step(by) {
    const list = this.list();
    const at = list.findIndex((each) => each.id === this.at);
    const next = list[Math.max(0, Math.min(list.length - 1, at + by))];
    if (next) this.choose(next.id);
  }

  /** Show a feature, whatever was shown. */
  see(feature) {
    this.what = isChange(feature) ? "changes" : "objects";
    this.choose(feature.id);
  }

  /** Judge what is shown, and go on to the next at once: whatever is pressed from now on is meant for that. */
  give(verdict, note = null) {
    const feature = this.screen.data.find(this.at);
    if (!feature || this.screen.station.status.role === "view") return;
    const list = this.list();
    const next = list[list.findIndex((each) => each.id === this.at) + 1]?.id;
    judge(this.screen, feature, verdict, note);
    if (verdict !== "none" && next) this.choose(next);
  }

  key(event) {
    const acts = {
      j: () => this.step(1), ArrowDown: () => this.step(1), ArrowRight: () => this.step(1), k: () => this.step(-1), ArrowUp: () => this.step(-1), ArrowLeft: () => this.step(-1),
      c: () => this.give("confirmed"), r: () => this.give("rejected"), u: () => this.give("none"), n: () => this.big.querySelector("input")?.focus(), m: () => this.map(), b: () => this.blink(),
    };
    const act = acts[event.key] ?? acts[event.key.toLowerCase()];
    act?.();
    return Boolean(act);
  }

  close() {
    this.big.remove();
  }
}
