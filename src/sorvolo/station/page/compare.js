// The room Compare: two dates of the map under a swipe, blinking, as their difference, or along the line of flights.

import { button, choice, el, field, fill, press, tick } from "./dom.js";
import { MapView, tie } from "./map_view.js";
import { badge, titleOf } from "./feature_card.js";
import { say } from "./languages.js";
import { day } from "./words.js";

const BLINK_MS = 700;
const dayOf = (version) => day(version.flown_at ?? version.made_at);

/** The room's life; the map shows `after`, a second map over it `before`. */
export class Compare {
  constructor(screen, body) {
    Object.assign(this, { screen, body, versions: screen.data.detail.versions ?? [], mode: "swipe", split: 50, isBare: false, at: -1, hadGaps: screen.view?.isShown("coverage") });
    if (this.versions.length < 2) {
      this.tooFew();
      return;
    }
    this.before = this.versions.at(-2).n;
    this.after = this.versions.at(-1).n;
    this.list = el("div");
    this.build();
    if (screen.view) {
      screen.view.show("coverage", true, false);
      screen.view.ready.then(() => this.begin());
    }
    this.apply();
  }

  tooFew() {
    const only = this.versions.length;
    this.versions = this.put = null;
    fill(this.body, el("p.hint", only ? say("The site has one version. Fly again and start a “compare” mission in “Live”: then two dates can be compared here.")
      : say("There is no map yet. Start a “map” mission in “Live”.")));
  }

  build() {
    const pairs = this.versions.map((each) => [each.n, `${each.n}: ${dayOf(each)} (${each.flight})`]);
    const pick = (name) => choice(pairs, this[name], (n) => { this[name] = Number(n); this.apply(); }, { data: { which: name } });
    const modes = [["swipe", say("Swipe")], ["side", say("Side by side")], ["blink", say("Blink")], ["difference", say("Difference")], ["before", say("Before")], ["after", say("After")]];
    fill(this.body,
      field(say("Before"), this.pickBefore = pick("before")), field(say("After"), this.pickAfter = pick("after")),
      el("div.segments", { role: "group", "aria-label": say("How to compare") }, this.buttons = modes.map(([mode, words]) =>
        button(words, () => this.use(mode), { data: { mode } }))),
      this.timeline(),
      this.overlays = tick(say("Show what was found (O)"), true, (on) => this.bare(!on)),
      this.list);
  }

  /** Flights where they lie in time, a button each: one tap shows the site as that flight left it. */
  timeline() {
    const times = this.versions.map((each) => +new Date(each.flown_at ?? each.made_at));
    const whole = Math.max(...times) - Math.min(...times) || 1;
    this.marks = this.versions.map((each, k) => {
      const mark = button([el("span.dot", { "aria-hidden": true }), el("span", dayOf(each)), el("small", each.flight)],
        () => this.jump(each.n), { class: "mark", title: say("Version {number}: {flight}", { number: String(each.n), flight: each.flight }) });
      mark.style.flexGrow = k ? Math.max(0.05, (times[k] - times[k - 1]) / whole) : 0;
      return mark;
    });
    return el("div.timeline", { role: "group", "aria-label": say("Flights in order of time") }, this.marks);
  }

  jump(n) {
    const at = this.versions.findIndex((each) => each.n === n);
    this.after = n;
    this.before = this.versions[Math.max(0, at - 1)].n;
    if (at === 0) this.use("after");
    this.pickBefore.value = this.before;
    this.pickAfter.value = this.after;
    this.apply();
  }

  begin() {
    if (this.closed) return;
    const { stage, view, data } = this.screen;
    this.cover = el("div.before-map", { inert: true });
    this.edge = el("input", { type: "range", min: 0, max: 100, step: 0.5, ".value": "50", class: "swipe", "aria-label": say("Swipe between before and after"), on: { input: () => this.cut(Number(this.edge.value)) } });
    this.handle = el("div.swipe-edge", { "aria-hidden": true }, el("span", "↔"));
    this.names = el("div.swipe-names", { "aria-hidden": true });
    stage.append(this.cover, this.names, this.handle, this.edge);
    this.handle.addEventListener("pointerdown", (event) => this.drag(event));
    this.other = new MapView(this.cover, data.detail, { bare: true });
    this.untie = tie(view.map, this.other.map);
    this.other.ready.then(() => this.apply());
    this.use(this.mode);
  }

  drag(event) {
    this.handle.setPointerCapture(event.pointerId);
    const follow = (moved) => {
      const box = this.screen.stage.getBoundingClientRect();
      this.cut(Math.max(0, Math.min(100, (moved.clientX - box.left) / box.width * 100)));
      this.edge.value = this.split;
    };
    this.handle.addEventListener("pointermove", follow);
    this.handle.addEventListener("pointerup", () => this.handle.removeEventListener("pointermove", follow), { once: true });
    event.preventDefault();
  }

  cut(split) {
    this.split = split;
    this.cover.style.clipPath = `inset(0 ${100 - split}% 0 0)`;
    this.handle.style.left = `${split}%`;
  }

  use(mode) {
    this.mode = mode;
    clearInterval(this.blinking);
    press(this.buttons, (each) => each.dataset.mode === mode);
    if (!this.cover) return;
    this.cover.classList.toggle("difference", mode === "difference");
    this.screen.stage.classList.toggle("side", mode === "side");
    this.put();
    const swiping = mode === "swipe";
    for (const each of [this.handle, this.edge]) each.hidden = !swiping;
    if (swiping) this.cut(this.split);
    else this.showWhole(["before", "difference", "side"].includes(mode));
    if (mode === "blink") {
      let on = false;
      this.blinking = setInterval(() => { on = !on; this.showWhole(on); }, BLINK_MS);
    }
    this.named();
  }

  showWhole(before) {
    this.cover.style.clipPath = before ? "none" : "inset(0 100% 0 0)";
    if (this.mode === "blink") this.named(before);
  }

  named(before = this.mode === "before") {
    const one = (words, n) => el("span", `${words}: ${dayOf(this.versions.find((each) => each.n === n))}`, el("small", ` (v${n})`));
    fill(this.names, ["swipe", "side", "difference"].includes(this.mode) ? [one(say("Before"), this.before), one(say("After"), this.after)] : before ? one(say("Before"), this.before) : one(say("After"), this.after));
  }

  apply() {
    const { data, view } = this.screen;
    data.versions = [this.before, this.after];
    data.dispatchEvent(new Event("filters"));
    view?.ready.then(() => { if (!this.closed) view.showVersion(this.after); });
    if (this.other) {
      this.other.ready.then(() => {
        this.other.showVersion(this.before);
        this.put();
      });
      this.named();
    }
    press(this.marks, (mark) => [this.before, this.after].includes(this.versions[this.marks.indexOf(mark)].n));
    this.refresh();
  }

  /** Draw what was found on both sides alike, or on neither: where they blink or are subtracted, ground alone is compared. */
  put() {
    const { data, view } = this.screen;
    const isBare = this.isBare || ["blink", "difference"].includes(this.mode);
    for (const each of [view, this.other]) {
      if (!each) continue;
      for (const name of ["changes", "objects"]) each.put(name, isBare ? [] : data.shown(name));
      each.put("drone", []);
      for (const name of ["track", "drawings", "coverage"]) each.put(name, isBare ? [] : name === "drawings" ? this.screen.zones ?? [] : data.all[name]);
    }
  }

  bare(on) {
    this.isBare = on;
    this.overlays.querySelector("input").checked = !on;
    this.put();
  }

  refresh() {
    if (!this.versions) return;
    const shown = this.changes;
    fill(this.list, el("h3", say("{n} change|{n} changes", { n: shown.length })), el("ol.changes", shown.map((each, k) =>
      el("li", button([badge(each), ` ${titleOf(each)}`, each.properties.untold ? el("small", ` ${say("by the search, not by the pictures' comparison")}`) : null], () => this.fly(k), { class: "link", "aria-current": k === this.at || null })))),
    el("p.note", say("Arrow keys fly from one to the next. Hatched ground could not be compared.")),
    shown.length ? button(say("Review them"), () => this.screen.open("findings"), { icon: "review" }) : null);
    if (this.other) this.put();
  }

  get changes() {
    return [...this.screen.data.shown("changes"), ...this.screen.data.untold()];
  }

  fly(k) {
    const shown = this.changes;
    if (!shown.length) return;
    this.at = (k + shown.length) % shown.length;
    this.screen.goTo(shown[this.at]);
    this.refresh();
  }

  key(event) {
    if (!this.versions) return false;
    const acts = { b: () => this.use(this.mode === "blink" ? "swipe" : "blink"), o: () => this.bare(!this.isBare), ArrowRight: () => this.fly(this.at + 1), ArrowLeft: () => this.fly(this.at - 1) };
    const act = event.target.closest?.(".maplibregl-map, input") && event.key.startsWith("Arrow") ? null : acts[event.key] ?? acts[event.key.toLowerCase()];
    act?.();
    return Boolean(act);
  }

  close() {
    this.closed = true;
    clearInterval(this.blinking);
    this.untie?.();
    this.other?.close();
    this.screen.stage.classList.remove("side");
    for (const each of [this.cover, this.handle, this.edge, this.names]) each?.remove();
    const { data, view } = this.screen;
    const wasCompared = Boolean(this.versions);
    this.versions = this.other = data.versions = null;
    this.put = null;
    if (wasCompared && view && !this.screen.closed) {
      view.showNewest(data.detail);
      view.show("coverage", this.hadGaps, false);
      this.screen.draw(["changes", "objects", "track", "coverage"]);
      view.put("drawings", this.screen.zones ?? []);
    }
  }
}
