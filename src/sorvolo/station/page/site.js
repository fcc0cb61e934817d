// The screen of one site: the map in the middle, panels beside it, live events into both.

import { get, siteUrl } from "./api.js";
import { showStationMap } from "./base_map.js";
import { choices } from "./choices.js";
import { button, el, fill, icon, message } from "./dom.js";
import { comparePanel } from "./compare.js";
import { drawPanel, loadDrawings } from "./draw.js";
import { exportPanel } from "./exports.js";
import { layersPanel } from "./layers.js";
import { followLive } from "./live.js";
import { canDraw, MapView } from "./map_view.js";
import { missionsPanel } from "./missions.js";
import { placePanel } from "./place.js";
import { boundsOf, middleOf } from "./places.js";
import { reviewPanel } from "./review.js";
import { SiteData } from "./site_data.js";
import { featureCard } from "./feature_card.js";
import { videoPane } from "./video.js";
import { siteName } from "./sites.js";
import { votes } from "./votes.js";
import * as words from "./words.js";

const PANELS = [
  ["map", "Map", "layers", layersPanel], ["review", "Review", "review", reviewPanel], ["compare", "Compare", "compare", comparePanel],
  ["place", "Place", "place", placePanel], ["draw", "Draw", "draw", drawPanel], ["missions", "Missions", "missions", missionsPanel],
  ["export", "Export", "export", exportPanel],
];

/** Show a site; gives what closes it. */
export async function showSite(main, title, numbers, station, id, view, at = null) {
  const isNew = view === "missions" && !(await isMade(id));
  const detail = isNew ? notMadeYet(id) : await get(siteUrl(id));
  return new SiteScreen(main, title, numbers, station, new SiteData(detail), view, at);
}

const isMade = async (id) => (await get("/api/sites")).some((each) => each.id === id);

function notMadeYet(id) {
  return { id, name: id, versions: [], flights: [], bounds_wgs84: null, center_wgs84: null, is_new: true };
}

class SiteScreen {
  constructor(main, title, numbers, station, data, view, at) {
    Object.assign(this, { station, data, numbers, ends: [], lastPlace: at });
    this.stage = el("section", { class: "stage", "aria-label": "Map" });
    this.panel = el("section", { class: "panel", id: "panel", tabindex: -1 });
    this.canvas = el("div", { class: "map-canvas" });
    this.readout = el("output", { class: "readout", "aria-label": "Place under the pointer" });
    this.stage.append(this.canvas, this.readout);
    this.tabs = el("nav", { class: "rail", "aria-label": "Panels" }, PANELS.map(([name, words_, drawn], k) =>
      el("button", { type: "button", data: { panel: name }, "aria-controls": "panel", title: `${words_} (${k + 1})`, on: { click: () => this.open(name, true) } },
        icon(drawn), el("span", {}, words_))));
    fill(main, el("div", { class: "site" }, this.tabs, this.panel, this.stage));
    fill(title, el("h1", {}, siteName(data.detail)));
    document.title = `${siteName(data.detail)} – Sorvolo`;
    this.begin(view);
  }

  begin(view) {
    if (!canDraw()) {
      fill(this.canvas, el("div", { class: "starting" }, el("h2", {}, "This browser cannot draw the map"),
        el("p", {}, "It has no WebGL 2. Use a newer Firefox, Chrome, Edge or Safari, or switch on hardware acceleration in its settings. Review, missions and export work without the map.")));
      this.view = null;
    } else {
      this.view = new MapView(this.canvas, this.data.detail, {
        onClick: (place, hits) => this.clicked(place, hits), onMove: (place, hits) => this.moved(place, hits),
      });
    }
    this.card = featureCard(this);
    this.live = followLive(this);
    this.video = videoPane(this);
    loadDrawings(this); // alert zones count on every panel
    this.onKey = (event) => this.key(event);
    addEventListener("keydown", this.onKey);
    this.hear(this.data, "data", (event) => this.draw(event.detail));
    this.hear(this.data, "filters", () => this.draw(["objects", "changes"]));
    this.hear(this.data, "chosen", () => this.drawChosen());
    this.hear(choices, "change", (event) => { this.view?.follow(); if (event.detail !== "layers") this.redraw(); });
    this.hear(matchMedia("(prefers-color-scheme: dark)"), "change", () => this.view?.follow());
    for (const type of ["site.changed", "run.finished", "run.stopped", "run.failed", "run.deleted"]) this.hear(this.station.events, type, (event) => this.reload(event.detail));
    this.hear(this.station.events, "site.gone", ({ detail }) => { if (detail.site === this.data.id) this.gone(); });
    this.hear(this.station.events, "state", ({ detail }) => { if (detail === "live") this.check(); });
    this.hear(this.station.events, "review.changed", ({ detail }) => { if (detail.site === this.data.id) this.data.judge(detail.data); });
    this.hear(votes, "change", () => { this.data.expect(); this.data.changed(["changes", "objects"]); });
    this.hear(votes, "taken", ({ detail: { vote, answer } }) => { if (vote.site === this.data.id) this.data.judge(answer); });
    this.hear(votes, "refused", ({ detail }) => this.refused(detail));
    this.open(view);
    this.load();
  }

  hear(target, type, listener) {
    target.addEventListener(type, listener);
    this.ends.push(() => target.removeEventListener(type, listener));
  }

  /** A vote that the station does not take: what it has is shown again. */
  refused({ vote, problem }) {
    if (vote.site !== this.data.id) return;
    const found = this.data.find(vote.id);
    message(`This verdict was not taken: ${problem.title}`, { kind: "error", todo: problem.detail,
      act: found ? button("Show it", () => (this.opened?.see ? this.opened.see(found) : this.data.choose(found))) : null });
    this.data.load([vote.kind === "change" ? "changes" : "objects"]).catch(() => {});
  }

  async load() {
    const { live_revision: live, versions, is_new: isNew } = this.data.detail;
    const drawn = this.view?.ready.then(() => {
      if (this.closed) return;
      this.view.showVersion(live ? `live-${live}` : versions.at(-1)?.n);
      showStationMap(this);
      if (this.lastPlace) this.view.go(this.lastPlace, 20.5, true);
    });
    if (!isNew) await this.data.load(["changes", "objects", "track"]);
    await drawn;
    if (!isNew) await this.data.load(["coverage", "frames", "pod"]); // mostly not shown at first
    if (!this.closed) this.opened?.refresh?.();
  }

  async reload({ site, type }) {
    if (site !== this.data.id) return;
    try {
      // its first mission failed, or the records of its missions go because it does
      if ((this.data.detail.is_new || type === "run.deleted") && !(await isMade(site))) return;
      const wasNew = this.data.detail.is_new || !this.data.detail.bounds_wgs84;
      await this.data.loadDetail();
      await this.data.load();
      if (this.view) {
        this.view.site = this.data.detail;
        if (wasNew && this.data.detail.bounds_wgs84) this.view.go(this.data.detail.bounds_wgs84);
        if (!this.opened?.versions) this.view.showVersion(`live-${this.data.detail.live_revision}`);
      }
    } catch (problem) {
      if (!this.lost(problem)) throw problem;
    }
  }

  /** Is the site still there? A station that was away announces nothing of what went meanwhile. */
  async check() {
    if (this.data.detail.is_new) return;
    try {
      await get(siteUrl(this.data.id));
    } catch (problem) { this.lost(problem); }
  }

  /** Whether an answer means that there is no such site, which ends the screen of one that was there. */
  lost({ status }) {
    if (status !== 404 && status !== 410) return false;
    if (!this.closed) this.gone();
    return true;
  }

  gone() {
    message("This site is gone", { kind: "error", todo: "Somebody deleted it. The list of sites shows the others." });
    location.hash = "#/";
  }

  /** Open a panel by its name. */
  open(name, byHand = false) {
    const found = PANELS.find(([each]) => each === name) ?? PANELS[0];
    if (byHand && this.shown === found[0]) {
      document.body.classList.toggle("folded");
      return;
    }
    document.body.classList.remove("folded");
    this.opened?.close?.();
    this.shown = found[0];
    for (const each of this.tabs.children) each.setAttribute("aria-pressed", String(each.dataset.panel === found[0]));
    this.stage.dataset.panel = found[0];
    const body = el("div", { class: `body ${found[0]}` });
    fill(this.panel, el("h2", {}, { draw: "Draw and measure", place: "Memory of a place" }[found[0]] ?? found[1]), body);
    this.panel.setAttribute("aria-label", found[1]);
    this.opened = found[3](this, body) ?? {};
    this.card.show(this.data.chosen);
    history.replaceState(null, "", `#/site/${encodeURIComponent(this.data.id)}/${found[0]}`);
    if (byHand) this.panel.focus({ preventScroll: true });
  }

  clicked(place, hits) {
    if (this.opened?.click?.(place, hits)) return;
    const hit = hits.find((each) => ["objects", "changes"].includes(each.source));
    const found = hit && this.data.find(hit.properties.id);
    if (found) this.data.choose(found);
    else {
      this.data.choose(null);
      if (!this.data.detail.is_new) {
        if (this.shown !== "place") this.open("place");
        this.opened.look?.(place);
      }
    }
  }

  moved(place, hits) {
    this.pointer = place;
    fill(this.readout, words.place(place, { local: this.data.detail.is_local }));
    this.view.map.getCanvas().style.cursor = this.opened?.cursor ?? (hits.length ? "pointer" : "");
    this.opened?.move?.(place);
  }

  draw(names) {
    if (this.view) {
      this.view.ready.then(() => {
        if (this.closed) return;
        for (const name of names) if (name in this.data.all) this.view.put(name, this.data.shown(name));
        this.drawChosen();
      });
    }
    this.opened?.refresh?.();
  }

  drawChosen() {
    const chosen = this.data.chosen;
    this.view?.put("chosen", chosen ? [chosen, { type: "Feature", properties: {}, geometry: { type: "Point", coordinates: middleOf(chosen.geometry) } }] : []);
    this.card.show(chosen);
    this.opened?.chosen?.(chosen);
  }

  redraw() {
    this.card.show(this.data.chosen);
    this.opened?.refresh?.();
    this.live.show();
  }

  /** Move the map to a feature. */
  goTo(feature) {
    const box = boundsOf([feature.geometry]);
    if (box) this.view?.go([(box[0] + box[2]) / 2, (box[1] + box[3]) / 2]);
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest?.("input, select, textarea, dialog")) return;
    if (this.opened?.key?.(event)) return event.preventDefault();
    const number = Number(event.key);
    if (number >= 1 && number <= PANELS.length) this.open(PANELS[number - 1][0], true);
    else if (event.key === "Escape") this.data.choose(null);
  }

  close() {
    this.closed = true;
    this.opened?.close?.();
    this.live.close();
    this.video.close();
    for (const end of this.ends) end();
    removeEventListener("keydown", this.onKey);
    document.body.classList.remove("folded");
    this.view?.close();
  }
}
