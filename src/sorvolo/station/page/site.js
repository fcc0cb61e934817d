// The screen of one site: three rooms, Live, Findings and Compare; the map with its tools; the sentence of what is known.

import { get, kept, siteUrl } from "./api.js";
import { showStationMap } from "./base_map.js";
import { choices } from "./choices.js";
import { comparePanel } from "./compare.js";
import { button, el, fill, icon, message } from "./dom.js";
import { drawPanel, loadDrawings } from "./draw.js";
import { exportPanel } from "./exports.js";
import { featureCard } from "./feature_card.js";
import { ALL, chips } from "./filters.js";
import { layersPanel } from "./layers.js";
import { followLive } from "./live.js";
import { canDraw, MapView } from "./map_view.js";
import { missionsPanel } from "./missions.js";
import { placePanel } from "./place.js";
import { boundsOf, middleOf } from "./places.js";
import { reviewPanel } from "./review.js";
import { sentence } from "./sentence.js";
import { SiteData } from "./site_data.js";
import { siteName } from "./sites.js";
import { videoWall } from "./video.js";
import { votes } from "./votes.js";
import * as words from "./words.js";

const ROOMS = { live: ["Live", missionsPanel], findings: ["Findings", reviewPanel], compare: ["Compare", comparePanel] };
const TOOLS = { layers: ["Layers", layersPanel, "layers"], measure: ["Measure and draw", drawPanel, "draw"], place: ["Memory of a place", placePanel, "place"], share: ["Share", exportPanel, "export"] };
const ALL_PANELS = { ...ROOMS, ...TOOLS };
const STOPS = ["half", "full", "peek"]; // of the sheet that a panel is on a phone
const RUNS_CHANGE = ["run.started", "run.finished", "run.stopped", "run.failed", "run.deleted"];
const STATUS_MS = 10000;

/** Show a site; gives what closes it. */
export async function showSite(frame, station, id, view, at = null) {
  const isNew = view === "live" && !(await isMade(id));
  const detail = isNew ? notMadeYet(id) : await get(siteUrl(id));
  return new SiteScreen(frame, station, new SiteData(detail), view, at);
}

const isMade = async (id) => (await get("/api/sites")).some((each) => each.id === id);

function notMadeYet(id) {
  return { id, name: id, versions: [], flights: [], bounds_wgs84: null, center_wgs84: null, is_new: true };
}

class SiteScreen {
  constructor({ main, title, rooms, known }, station, data, view, at) {
    Object.assign(this, { station, data, known, ends: [], lastPlace: at, room: "live", loaded: "no", runs: [] });
    this.stage = el("section", { class: "stage", "aria-label": "Map" });
    this.panel = el("section", { class: "panel", id: "panel", tabindex: -1, data: { stop: "half" } });
    this.canvas = el("div", { class: "map-canvas" });
    this.readout = el("output", { class: "readout", "aria-label": "Place under the pointer" });
    this.chips = el("div", { class: "chips" });
    this.stage.append(this.canvas, this.chips, this.readout);
    this.wall = el("section", { class: "wall", "aria-label": "Videos", hidden: true });
    this.tabs = Object.entries(ROOMS).map(([name, [words_]]) => el("button", { type: "button", data: { panel: name }, "aria-controls": "panel", on: { click: () => this.open(name, true) } }, words_));
    fill(rooms, this.tabs, el("button", { type: "button", class: "share", data: { panel: "share" }, "aria-controls": "panel", on: { click: () => this.open("share", true) } }, icon("export"), el("span", {}, "Share")));
    this.tabs.push(rooms.lastElementChild);
    fill(main, el("div", { class: "site" }, this.panel, this.stage, this.wall));
    fill(title, el("h1", {}, siteName(data.detail)));
    document.title = `${siteName(data.detail)} – Sorvolo`;
    this.tell(); // before the map is made: it lies over the map's ground
    this.begin(view);
  }

  begin(view) {
    if (!canDraw()) {
      fill(this.canvas, el("div", { class: "starting" }, el("h2", {}, "This browser cannot draw the map"),
        el("p", {}, "It has no WebGL 2. Use a newer Firefox, Chrome, Edge or Safari, or switch on hardware acceleration in its settings. Findings, missions and exports work without the map.")));
      this.view = null;
    } else {
      this.view = new MapView(this.canvas, this.data.detail, {
        onClick: (place, hits) => this.clicked(place, hits), onMove: (place, hits) => this.moved(place, hits), onDrag: () => this.follow(false),
      });
      this.stage.append(this.tools());
    }
    this.card = featureCard(this);
    this.live = followLive(this);
    this.video = videoWall(this);
    loadDrawings(this); // alert zones count in every room
    this.onKey = (event) => this.key(event);
    addEventListener("keydown", this.onKey);
    const { events } = this.station;
    const here = (listener) => ({ detail }) => { if (detail.site === this.data.id) listener(detail); };
    this.hear(this.data, "data", (event) => this.draw(event.detail));
    this.hear(this.data, "filters", () => { fill(this.chips, chips(this.data)); this.draw(["objects", "changes"]); });
    this.hear(this.data, "chosen", () => this.drawChosen());
    this.hear(choices, "change", (event) => { this.view?.follow(); if (event.detail !== "layers") this.redraw(); });
    this.hear(matchMedia("(prefers-color-scheme: dark)"), "change", () => this.view?.follow());
    for (const type of ["site.changed", ...RUNS_CHANGE.slice(1)]) this.hear(events, type, (event) => this.reload(event.detail));
    this.hear(events, "run.started", here(() => this.loadRuns()));
    this.hear(events, "run.progress", here(({ run, data }) => { const found = this.runs.find(({ id }) => id === run); if (found) { found.progress = data; this.opened?.running?.(); this.tell(); } }));
    this.hear(events, "site.gone", here(() => this.gone()));
    this.hear(events, "state", ({ detail }) => { if (detail === "live") this.check(); this.tell(); });
    this.hear(events, "review.changed", here(({ data }) => this.data.judge(data)));
    this.hear(votes, "change", () => { this.data.expect(); this.data.changed(["changes", "objects"]); });
    this.hear(votes, "taken", ({ detail: { vote, answer } }) => { if (vote.site === this.data.id) this.data.judge(answer); });
    this.hear(votes, "refused", ({ detail }) => this.refused(detail));
    this.hear(window, "dragover", (event) => event.preventDefault());
    this.hear(window, "drop", (event) => {
      event.preventDefault();
      if (event.dataTransfer.files.length) { this.open("live", true); this.opened.take(event.dataTransfer.files); }
    });
    const timers = [setInterval(() => this.tell(), 1000), setInterval(() => this.look(), STATUS_MS)];
    this.ends.push(() => timers.forEach(clearInterval));
    this.open(view);
    this.load();
  }

  /** What is done on the map itself. */
  tools() {
    const tool = (words_, drawn, act, props = {}) => el("button", { type: "button", title: words_, "aria-label": words_, on: { click: act }, ...props }, icon(drawn));
    this.follower = tool("Follow the drone", "video", () => this.follow(!this.live.follows), { "aria-pressed": "true" });
    return el("div", { class: "map-tools", role: "toolbar", "aria-label": "Map tools" },
      tool("Whole site", "fit", () => { if (this.data.detail.bounds_wgs84) this.view.go(this.data.detail.bounds_wgs84); this.follow(false); }), this.follower,
      Object.entries(TOOLS).filter(([name]) => name !== "share").map(([name, [words_, , drawn]]) => tool(words_, drawn, () => (this.shown === name ? this.open(this.room) : this.open(name, true)), { data: { panel: name } })));
  }

  /** Keep the drone in the middle of the map, until somebody moves it. */
  follow(on) {
    if (!this.live || this.live.follows === on) return;
    this.live.follows = on;
    this.follower.setAttribute("aria-pressed", String(on));
    if (on) this.live.drawSoon();
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
      if (!this.lastPlace) return;
      this.follow(false);
      this.view.go(this.lastPlace, 20.5, true);
    });
    try {
      await this.learn(async () => {
        await this.loadRuns();
        if (!isNew) await this.data.load(["changes", "objects", "track", "pod"]);
        else if (this.runs.some(({ mission }) => mission === "watch")) await this.data.load(["objects"]); // that needs no map
      });
      await drawn;
      if (!isNew) await this.data.load(["coverage", "frames"]); // mostly not shown at first
    } catch (problem) {
      if (problem.status !== 401) throw problem;
    }
    if (!this.closed) this.opened?.refresh?.();
  }

  /** Load what the sentence states; where that fails, or what comes was kept, it says so. */
  async learn(load) {
    const before = kept.answers;
    try {
      await load();
      Object.assign(this, { loaded: "yes", isOld: kept.answers > before });
    } catch (problem) {
      this.loaded = "failed";
      throw problem;
    } finally { this.tell(); }
  }

  async loadRuns() {
    this.runs = await get(`/api/runs?site=${encodeURIComponent(this.data.id)}`);
    this.opened?.running?.();
    this.video?.look();
    this.tell();
  }

  /** The station's own state: its disk, who is logged in; and what could not be loaded is tried again. */
  async look() {
    try {
      this.station.status = { ...this.station.status, ...await get("/api/status") };
      if (this.closed || this.station.events.state !== "live") return;
      if (this.station.status.name !== votes.who) location.reload(); // another tab changed it
      if (this.loaded === "failed" || this.isOld) await this.reload({ site: this.data.id });
    } catch { /* the sentence states it */ }
  }

  /** State what is known, in a sentence whose parts lead to it. */
  tell() {
    if (this.closed) return;
    const { status, events } = this.station;
    const { objects, changes, pod } = this.data.all;
    const parts = sentence({ link: events.state === "live" && this.isOld ? "late" : events.state, loaded: this.loaded, runs: this.runs, objects, changes, pod, versions: this.data.detail.versions, votes: votes.mine.length,
      isLow: status.disk_floor_gb !== undefined && status.disk_free_gb < 2 * status.disk_floor_gb });
    const text = JSON.stringify(parts);
    if (text === this.told) return;
    this.told = text;
    this.known.dataset.loaded = this.loaded;
    const acts = { live: () => this.open("live", true), review: () => this.open("findings", true), compare: () => this.open("compare", true), coverage: () => { this.view?.show("pod", true); this.open("layers", true); } };
    fill(this.known, parts.map(({ words: said, act, kind }, k) => [k ? " · " : null, act ? el("button", { type: "button", class: `link ${kind}`, on: { click: acts[act] } }, said) : el("span", { class: kind }, said)]));
  }

  async reload({ site, type, data }) {
    if (site !== this.data.id) return;
    try {
      // its first mission failed, or the records of its missions go because it does
      const isHere = !(this.data.detail.is_new || type === "run.deleted") || await isMade(site);
      const wasNew = this.data.detail.is_new || !this.data.detail.bounds_wgs84;
      await this.learn(async () => {
        if (isHere) {
          await this.data.loadDetail();
          await this.data.load();
        }
        await this.loadRuns(); // after what they found: a mission is not called done before that is known
      });
      if (this.closed) return;
      if (["run.finished", "run.stopped"].includes(type) && data?.state !== "incomplete") this.live.done(data ?? {});
      if (!isHere) return;
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
      if (this.loaded === "failed") await this.reload({ site: this.data.id });
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

  /** Open a room, or a tool beside the map, by its name. */
  open(name, byHand = false) {
    const shown = name in ALL_PANELS ? name : "live";
    this.opened?.close?.();
    this.shown = shown;
    if (shown in ROOMS) this.room = shown;
    for (const each of [...this.tabs, ...this.stage.querySelectorAll(".map-tools [data-panel]")]) each.setAttribute("aria-pressed", String(each.dataset.panel === shown));
    this.stage.dataset.panel = document.body.dataset.panel = shown;
    const [words_, made] = ALL_PANELS[shown];
    const body = el("div", { class: `body ${shown}` });
    fill(this.panel, el("div", { class: "panel-head" }, button("", () => this.resize(), { class: "quiet handle", "aria-label": "More or less of this sheet" }), el("h2", {}, words_),
      shown in TOOLS ? button("Close", () => this.open(this.room), { class: "quiet", icon: "close" }) : null), body);
    this.panel.setAttribute("aria-label", words_);
    if (byHand && this.panel.dataset.stop === "peek") this.resize("half");
    this.opened = made(this, body) ?? {};
    this.card.show(this.data.chosen);
    history.replaceState(null, "", `#/site/${encodeURIComponent(this.data.id)}/${shown}`);
    if (byHand) this.panel.focus({ preventScroll: true });
  }

  /** The sheet of a phone at its next stop, or at one that is named. */
  resize(stop = STOPS[(STOPS.indexOf(this.panel.dataset.stop) + 1) % STOPS.length]) {
    this.panel.dataset.stop = stop;
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
        this.opened.look?.(place, hits);
      }
    }
  }

  moved(place, hits) {
    fill(this.readout, words.place(place, { local: this.data.detail.is_local }));
    this.view.map.getCanvas().style.cursor = this.opened?.cursor ?? (hits.length ? "pointer" : "");
    this.opened?.move?.(place);
  }

  draw(names) {
    if (this.view) {
      this.view.ready.then(() => {
        if (this.closed) return;
        if (this.opened?.put) this.opened.put(); // Compare draws both sides alike
        else for (const name of names) if (name in this.data.all) this.view.put(name, this.data.shown(name));
        this.drawChosen();
      });
    }
    this.opened?.refresh?.();
    this.tell();
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
  }

  /** Move the map to a feature. */
  goTo(feature) {
    const box = boundsOf([feature.geometry]);
    this.follow(false);
    if (box) this.view?.go([(box[0] + box[2]) / 2, (box[1] + box[3]) / 2]);
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest?.("input:not([type=range], [type=checkbox]), select, textarea, dialog")) return;
    if (this.opened?.key?.(event)) return event.preventDefault();
    const name = Object.keys(ROOMS)[Number(event.key) - 1];
    if (name) this.open(name, true);
    else if (event.key === "Escape") {
      if (this.data.chosen) this.data.choose(null);
      else if (this.shown in TOOLS) this.open(this.room);
      else if (this.data.filters !== ALL) this.data.filter(ALL);
    }
  }

  close() {
    this.closed = true;
    this.opened?.close?.();
    this.live.close();
    this.video.close();
    for (const end of this.ends) end();
    removeEventListener("keydown", this.onKey);
    delete document.body.dataset.panel;
    this.view?.close();
  }
}
