// The room Findings: objects and changes one after another, large pictures, judged with the keyboard.

import { get, siteUrl } from "./api.js";
import { choices } from "./choices.js";
import { button, choice, el, fill, icon, press, quiet, svg, tick } from "./dom.js";
import { badge, facts, isWritten, picture, pictures, titleOf } from "./feature_card.js";
import { say } from "./languages.js";
import { metresOfDegree, middleOf, polygonsOf } from "./places.js";
import { handover } from "./share.js";
import { apart, jump } from "./place.js";
import { time, VERDICTS } from "./words.js";
import { cropsOf, isChange, newestFirst, peopleFirst } from "./site_data.js";
import { judge, verdictForm } from "./verdicts.js";

const ORDERS = {
  score: [say("Highest confidence"), (one, other) => (other.properties.score ?? 0) - (one.properties.score ?? 0)],
  doubt: [say("Lowest confidence"), (one, other) => (one.properties.score ?? 0) - (other.properties.score ?? 0)],
  size: [say("Largest first"), (one, other) => (other.properties.area_m2 ?? other.properties.length_m ?? 0) - (one.properties.area_m2 ?? one.properties.length_m ?? 0)],
  time: [say("Newest first"), newestFirst],
};

/** A thing's outline in 10 m of ground around it, north up: as it is known, else a circle of its size. */
function outlineOf({ geometry, properties: { length_m: length } }) {
  const [lon, lat] = middleOf(geometry);
  if (geometry.type === "Point") return svg("circle", { cx: 5, cy: 5, r: 0.65 * Math.max(1, Math.min(8, length || 2)) });
  const [x_m, y_m] = metresOfDegree(lat);
  const path = polygonsOf(geometry).flat().map((ring) => `M${ring.map(([x, y]) => `${(5 + (x - lon) * x_m).toFixed(2)} ${(5 - (y - lat) * y_m).toFixed(2)}`).join("L")}Z`);
  return svg("path", { d: path.join(""), class: "outline" });
}

/** The room's life: a strip of all, and the stage's large card. */
export class Review {
  constructor(screen, body) {
    Object.assign(this, { screen, what: "objects", order: "score", open: false, at: null, isWide: false, views: [] });
    if (screen.data.chosen ? isChange(screen.data.chosen) : !screen.data.all.objects.length) this.what = "changes";
    this.head = el("div");
    this.strip = el("ul.strip", { "aria-label": say("To review") });
    this.big = el("div.gallery");
    screen.stage.append(this.big);
    fill(body, this.head, this.strip);
    screen.card.show(null);
    this.at = screen.data.chosen?.id ?? null;
    this.refresh();
  }

  shown(what = this.what) {
    return this.screen.data.shown(what);
  }

  list() {
    const shown = this.shown().filter((each) => !this.open || !each.properties.review || each.id === this.at);
    return peopleFirst(shown, ORDERS[this.order][1]);
  }

  refresh() {
    if (!this.isChosen && !this.screen.data.chosen) this.what = this.shown("objects").length || !this.shown("changes").length ? "objects" : "changes"; // while it loads
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
      el("div.segments", { role: "group", "aria-label": say("What to review") }, ["objects", "changes"].map((what) =>
        button(`${what === "changes" ? say("Changes") : say("Objects")} (${this.shown(what).length})`, () => { this.isChosen = true; this.what = what; this.choose(null); }, { "aria-pressed": what === this.what }))),
      el("div.review-order", choice(Object.entries(ORDERS).map(([key, [words]]) => [key, words]), this.order,
        (order) => { this.order = order; this.refresh(); }, { "aria-label": say("Order") }),
        tick(say("Unreviewed only"), this.open, (open) => { this.open = open; this.refresh(); })),
      all.length ? el("div.progress", el("progress", { max: all.length, value: done, "aria-label": say("Reviewed") }), el("span", say("{n} of {all} reviewed", { n: done, all: all.length }))) : null,
      list.length ? null : el("p.hint", all.length ? say("All reviewed. Untick “Unreviewed only” to see them again.") : `${this.what === "changes" ? say("No changes to review") : say("No objects to review")}${this.screen.data.all[this.what].length ? `: ${say("the filter hides them all")}` : ""}.`));
  }

  item(feature) {
    const chosen = feature.id === this.at;
    const words = { confirmed: "check", rejected: "cross" }[feature.properties.review];
    return el("li", button([
      cropsOf(feature).length ? picture(cropsOf(feature).at(feature.properties.kind === "disappeared" ? 0 : -1), "") : el("div.gone", say("no picture yet")),
      el("span.name", badge(feature), titleOf(feature)),
      words ? el("span.mark", icon(words), el("span.sr", VERDICTS[feature.properties.review])) : null,
    ], () => this.choose(feature.id), { "aria-current": chosen || null, data: { id: feature.id }, class: feature.properties.review ?? "open" }));
  }

  showBig(list) {
    const at = list.findIndex((each) => each.id === this.at);
    this.big.hidden = at < 0;
    if (at < 0) return;
    if (isWritten(this.big) && this.drawn === this.at) return;
    const feature = list[at];
    const state = JSON.stringify([feature, at, list.length, choices.all]);
    if (state === this.told) return; // what a person is about to press stays under the finger
    Object.assign(this, { drawn: this.at, told: state });
    this.pictures = pictures(feature);
    this.film = el("ol.film", { tabindex: 0, "aria-label": say("Seen here, in order of time") });
    const { data } = this.screen;
    const place = middleOf(feature.geometry);
    fill(this.big,
      el("div.gallery-head", badge(feature), el("h3", titleOf(feature)), el("span.soft", say("{n} of {all}", { n: at + 1, all: list.length })),
        button(say("10 m around"), () => this.around(feature), { "aria-pressed": this.isWide }),
        button(say("Previous"), () => this.step(-1), { "aria-keyshortcuts": "K" }), button(say("Next"), () => this.step(1), { "aria-keyshortcuts": "J" })),
      this.pictures, this.film,
      el("div.gallery-foot", facts(feature, data.detail.is_local),
        el("div", verdictForm(this.screen, feature, { keys: true, given: (verdict, note) => this.give(verdict, note) }),
          el("div.row", button(say("Show on the map"), () => this.map(), { icon: "target", "aria-keyshortcuts": "M" }),
            isChange(feature) ? quiet(say("Blink"), () => this.blink(), { "aria-keyshortcuts": "B" }) : null),
          data.detail.is_local ? null : handover(data.id, titleOf(feature), place, feature.properties.sigma_m))));
    this.showFilm(feature, place);
    this.strip.querySelector("[aria-current]")?.scrollIntoView({ block: "nearest" });
  }

  /** Every picture of the place, 10 m of ground each, north up; a tap makes one large. */
  async showFilm(feature, place) {
    const film = this.film;
    const views = await get(`${siteUrl(this.screen.data.id, "place")}?lon=${place[0]}&lat=${place[1]}`).catch(() => []);
    if (film !== this.film) return;
    this.views = views.filter((each) => each.crop_url);
    fill(film, apart(this.views).map((each) => el("li", button(picture(each.crop_url, ""), () => this.large(feature, [each]), { class: "frame", "aria-label": say("Seen {time}", { time: time(each.time) }) }), jump(this.screen, each, place))));
    if (this.isWide) this.wide(feature);
  }

  /** The surroundings in place of the crops, or back; kept from one to the next. */
  around(feature) {
    this.isWide = !this.isWide;
    press([this.big.querySelector(".gallery-head [aria-pressed]")], () => this.isWide);
    if (this.isWide) this.wide(feature);
    else this.pictures.replaceWith(this.pictures = pictures(feature));
  }

  /** What the flight that found it saw around it; of a change, what an earlier one saw, too. */
  wide(feature) {
    const { flight, first_seen: first } = feature.properties;
    const middle = (list) => list.slice(list.length >> 1)[0];
    const views = apart(this.views);
    const own = views.filter((each) => each.flight === flight);
    const earlier = isChange(feature) ? views.filter((each) => each.flight !== flight && each.time < first) : [];
    const shown = [middle(earlier.filter((each) => each.flight === earlier.at(-1).flight)), middle(own) ?? views[0]].filter(Boolean);
    if (shown.length) this.large(feature, shown);
  }

  /** Pictures of 10 m of ground with the thing's outline, a scale bar and north. */
  large(feature, views) {
    const shown = el("div", { class: `pictures n${views.length}` }, views.map((view) => el("figure.ground", picture(view.crop_url, `${say("10 m around")}, ${time(view.time)}`),
      svg("svg", { viewBox: "0 0 10 10", class: "scale", "aria-hidden": "true" }, outlineOf(feature), svg("path", { d: "M.5 9.5h2M9.5 2V.6m-.3.5.3-.5.3.5" }),
        svg("text", { x: 0.5, y: 9.2 }, "2 m"), svg("text", { x: 9.35, y: 2.6 }, "N")), el("figcaption", time(view.time)))));
    this.pictures.replaceWith(shown);
    this.pictures = shown;
  }

  blink() {
    this.pictures.classList.toggle("blinking");
  }

  map() {
    const feature = this.screen.data.find(this.at);
    this.screen.live.showFound(feature);
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
    this.isChosen = true;
    this.what = isChange(feature) ? "changes" : "objects";
    this.choose(feature.id);
  }

  /** Judge what is shown, and go on to the next at once: whatever is pressed from now on is meant for that. */
  give(verdict, note = null) {
    const feature = this.screen.data.find(this.at);
    if (!feature || !this.screen.station.reviews) return;
    const list = this.list();
    const next = list[list.findIndex((each) => each.id === this.at) + 1]?.id;
    judge(this.screen, feature, verdict, note);
    if (verdict !== "none" && next) this.choose(next);
  }

  key(event) {
    const acts = {
      j: () => this.step(1), ArrowDown: () => this.step(1), ArrowRight: () => this.step(1), k: () => this.step(-1), ArrowUp: () => this.step(-1), ArrowLeft: () => this.step(-1),
      c: () => this.give("confirmed"), y: () => this.give("confirmed"), "?": () => this.give("unsure"), r: () => this.give("rejected"), u: () => this.give("none"), n: () => this.big.querySelector("input")?.focus(), m: () => this.map(), b: () => this.blink(),
    };
    const act = acts[event.key] ?? acts[event.key.toLowerCase()];
    act?.();
    return Boolean(act);
  }

  close() {
    this.big.remove();
  }
}
