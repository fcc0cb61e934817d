// Before and after: two versions of the map side by side under a swipe, blinking, or along the line of flights.

import { button, choice, el, field, fill, tick } from "./dom.js";
import { MapView, tie } from "./map_view.js";
import { KINDS } from "./map_style.js";
import { counted, day } from "./words.js";

const BLINK_MS = 700;

/** The panel's life; the map shows `after`, a second map over it `before`. */
export function comparePanel(screen, body) {
  return new Compare(screen, body);
}

class Compare {
  constructor(screen, body) {
    Object.assign(this, { screen, body, versions: screen.data.detail.versions ?? [], mode: "swipe", split: 50 });
    if (this.versions.length < 2) {
      this.tooFew();
      return;
    }
    this.before = this.versions.at(-2).n;
    this.after = this.versions.at(-1).n;
    this.list = el("div", {});
    this.build();
    if (screen.view) screen.view.ready.then(() => this.begin());
    this.apply();
  }

  tooFew() {
    const only = this.versions.length;
    this.versions = null;
    fill(this.body, el("p", { class: "hint" }, only ? "The site has one version. Fly again and start a “compare” mission: then two dates can be compared here."
      : "There is no map yet. Start a “map” mission under “Missions”."));
  }

  build() {
    const pairs = this.versions.map((each) => [each.n, `${each.n}: ${day(each.flown_at ?? each.made_at)} (${each.flight})`]);
    const pick = (name) => choice(pairs, this[name], (n) => { this[name] = Number(n); this.apply(); }, { data: { which: name } });
    const modes = [["swipe", "Swipe"], ["blink", "Blink"], ["before", "Before"], ["after", "After"]];
    fill(this.body,
      field("Before", this.pickBefore = pick("before")), field("After", this.pickAfter = pick("after")),
      el("div", { class: "segments", role: "group", "aria-label": "How to compare" }, this.buttons = modes.map(([mode, words]) =>
        el("button", { type: "button", data: { mode }, on: { click: () => this.use(mode) } }, words))),
      this.timeline(),
      tick("Only changes between these versions", true, (on) => { this.narrow = on; this.apply(); }),
      this.list);
    this.narrow = true;
  }

  /** Flights in their order, a button each: one tap shows the site as that flight left it. */
  timeline() {
    this.marks = this.versions.map((each) => el("button", { type: "button", class: "mark", title: `Version ${each.n}: ${each.flight}`, on: { click: () => this.jump(each.n) } },
      el("span", { class: "dot", "aria-hidden": true }), el("span", {}, day(each.flown_at ?? each.made_at)), el("small", {}, each.flight)));
    return el("div", { class: "timeline", role: "group", "aria-label": "Flights in order of time" }, this.marks);
  }

  jump(n) {
    const at = this.versions.findIndex((each) => each.n === n);
    this.after = n;
    this.before = this.versions[Math.max(0, at - 1)].n;
    if (at === 0) this.use("after");
    this.pickBefore.value = String(this.before);
    this.pickAfter.value = String(this.after);
    this.apply();
  }

  begin() {
    if (this.closed) return;
    const { stage, view, data } = this.screen;
    this.cover = el("div", { class: "before-map", inert: true });
    this.edge = el("input", { type: "range", min: 0, max: 100, step: 0.5, ".value": "50", class: "swipe", "aria-label": "Swipe between before and after", on: { input: () => this.cut(Number(this.edge.value)) } });
    this.handle = el("div", { class: "swipe-edge", "aria-hidden": true }, el("span", {}, "↔"));
    this.names = el("div", { class: "swipe-names", "aria-hidden": true });
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
      this.edge.value = String(this.split);
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
    for (const each of this.buttons) each.setAttribute("aria-pressed", String(each.dataset.mode === mode));
    if (!this.cover) return;
    const swiping = mode === "swipe";
    for (const each of [this.handle, this.edge]) each.hidden = !swiping;
    if (swiping) this.cut(this.split);
    else this.showWhole(mode === "before");
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
    const name = (n) => { const found = this.versions.find((each) => each.n === n); return day(found.flown_at ?? found.made_at); };
    const one = (words, n) => el("span", {}, `${words}: ${name(n)}`, el("small", {}, ` (v${n})`));
    fill(this.names, this.mode === "swipe" ? [one("Before", this.before), one("After", this.after)] : before ? one("Before", this.before) : one("After", this.after));
  }

  apply() {
    const { data, view } = this.screen;
    data.versions = this.narrow ? [this.before, this.after] : null;
    data.dispatchEvent(new Event("filters"));
    view?.ready.then(() => { if (!this.closed) view.showVersion(this.after); });
    if (this.other) {
      this.other.ready.then(() => {
        this.other.showVersion(this.before);
        this.other.put("changes", data.shown("changes"));
      });
      this.named();
    }
    this.marks.forEach((mark, k) => mark.setAttribute("aria-pressed", String([this.before, this.after].includes(this.versions[k].n))));
    this.refresh();
  }

  refresh() {
    if (!this.versions) return;
    const shown = this.screen.data.shown("changes");
    const groups = Object.entries(KINDS).map(([kind, [name]]) => [name, shown.filter((each) => each.properties.kind === kind).length]).filter(([, count]) => count);
    fill(this.list, el("h3", {}, counted(shown.length, "change")), el("ul", { class: "plain" }, groups.map(([name, count]) => el("li", {}, `${count} ${name}`))),
      shown.length ? button("Review them", () => this.screen.open("review"), { icon: "review" }) : null);
    this.other?.put("changes", shown);
  }

  key(event) {
    if (!this.versions) return false;
    if (event.key.toLowerCase() === "b") this.use(this.mode === "blink" ? "swipe" : "blink");
    else return false;
    return true;
  }

  close() {
    this.closed = true;
    clearInterval(this.blinking);
    this.untie?.();
    this.other?.close();
    for (const each of [this.cover, this.handle, this.edge, this.names]) each?.remove();
    const { data, view } = this.screen;
    data.versions = null;
    if (this.versions && view && !this.screen.closed) {
      view.showVersion(data.detail.live_revision ? `live-${data.detail.live_revision}` : this.versions.at(-1).n);
      data.dispatchEvent(new Event("filters"));
    }
  }
}
