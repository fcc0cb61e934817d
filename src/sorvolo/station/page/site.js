// The screen of one site: three rooms, Live, Findings and Compare; the map with its tools; the sentence of what is known.

import { get, kept, now, roomUrl, siteUrl } from "./api.js";
import { showStationMap } from "./base_map.js";
import { choices } from "./choices.js";
import { Compare } from "./compare.js";
import { button, el, fill, message, press, quiet } from "./dom.js";
import { Draw, loadDrawings, sendDrawings } from "./draw.js";
import { exportPanel } from "./exports.js";
import { featureCard } from "./feature_card.js";
import { ALL, chips } from "./filters.js";
import { say } from "./languages.js";
import { layersPanel } from "./layers.js";
import { Live } from "./live.js";
import { canDraw, MapView } from "./map_view.js";
import { Missions } from "./missions.js";
import { placePanel } from "./place.js";
import { featureOf, middleOf } from "./places.js";
import { Review } from "./review.js";
import { sentence } from "./sentence.js";
import { SiteData } from "./site_data.js";
import { siteName } from "./sites.js";
import { VideoWall } from "./video.js";
import { votes } from "./votes.js";
import * as words from "./words.js";

const ROOMS = { live: [say("Live"), Missions], findings: [say("Findings"), Review], compare: [say("Compare"), Compare] };
const TOOLS = { layers: [say("Layers"), layersPanel, "layers"], measure: [say("Measure and draw"), Draw, "draw"], place: [say("Memory of a place"), placePanel, "place"], share: [say("Share"), exportPanel, "export"] };
const ALL_PANELS = { ...ROOMS, ...TOOLS };
const STOPS = ["half", "full", "peek"]; // of the sheet that a panel is on a phone
const STATUS_MS = 10000;
const RENEW_MS = 1500; // after the last verdict

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
    Object.assign(this, { station, data, known, over: new AbortController(), lastPlace: at, room: "live", loaded: "no", runs: [] });
    this.stage = el("section.stage", { "aria-label": say("Map") });
    this.panel = el("section.panel", { id: "panel", tabindex: -1, data: { stop: "half" } });
    this.canvas = el("div.map-canvas");
    this.readout = el("output.readout", { "aria-label": say("Place under the pointer") });
    this.chips = el("div.chips");
    this.stage.append(this.canvas, this.chips, this.readout);
    this.wall = el("section.wall", { "aria-label": say("Videos"), hidden: true });
    const tab = (name, props) => button(ALL_PANELS[name][0], () => this.open(name, true), { data: { panel: name }, "aria-controls": "panel", ...props });
    fill(rooms, this.tabs = [...Object.keys(ROOMS).map((name) => tab(name)), tab("share", { icon: "export", class: "share" })]);
    fill(main, el("div.site", this.panel, this.stage, this.wall));
    fill(title, this.heading = el("h1"), this.people = el("span.soft.present"));
    this.name();
    this.tell(); // before the map is made: it lies over the map's ground
    this.begin(view);
  }

  name() {
    const name = siteName(this.data.detail);
    fill(this.heading, name);
    document.title = `${name} – Sorvolo`;
  }

  begin(view) {
    if (!canDraw()) {
      fill(this.canvas, el("div.starting", el("h2", say("This browser cannot draw the map")),
        el("p", say("It has no WebGL 2. Use a newer Firefox, Chrome, Edge or Safari, or switch on hardware acceleration in its settings. Findings, missions and exports work without the map."))));
      this.view = null;
    } else {
      this.view = new MapView(this.canvas, this.data.detail, {
        onClick: (place, hits) => this.clicked(place, hits), onMove: (place, hits) => this.moved(place, hits), onDrag: () => this.follow(false),
      });
      this.stage.append(this.tools());
    }
    this.card = featureCard(this);
    this.live = new Live(this);
    this.video = new VideoWall(this);
    loadDrawings(this); // alert zones count in every room
    this.hear(window, "keydown", (event) => this.key(event));
    const { events } = this.station;
    this.hear(this.data, "data", (event) => this.draw(event.detail));
    this.hear(this.data, "filters", () => { fill(this.chips, chips(this.data)); this.draw(["objects", "changes"]); });
    this.hear(this.data, "chosen", () => this.drawChosen());
    this.hear(choices, "change", (event) => { this.view?.follow(); if (event.detail !== "layers") this.redraw(); });
    this.hear(matchMedia("(prefers-color-scheme: dark)"), "change", () => this.view?.follow());
    for (const type of ["site.changed", "run.finished", "run.stopped", "run.failed", "run.deleted"]) this.on(type, (data, event) => this.reload(event));
    this.on("run.started", () => this.loadRuns());
    this.on("run.progress", (data, { run }) => { const found = this.runs.find(({ id }) => id === run); if (found) { found.progress = data; this.opened?.running?.(); this.tell(); } });
    this.on("site.gone", () => this.gone());
    this.hear(events, "state", ({ detail }) => { if (detail === "live") this.check(); this.tell(); });
    this.on("review.changed", (data) => { this.data.judge(data); this.renew(); });
    this.hear(votes, "change", () => { this.data.expect(); this.data.changed(["changes", "objects"]); });
    this.hear(votes, "taken", ({ detail: { vote, answer } }) => { if (vote.site === this.data.id) { this.data.judge(answer); this.renew(); } });
    this.hear(window, "dragover", (event) => event.preventDefault());
    this.hear(window, "drop", (event) => {
      event.preventDefault();
      if (event.dataTransfer.files.length) { this.open("live", true); this.opened.take(event.dataTransfer.files); }
    });
    this.timers = [setInterval(() => this.tell(), 1000), setInterval(() => this.look(), STATUS_MS)];
    fill(this.chips, chips(this.data)); // of before a reload
    this.open(view);
    this.load();
    this.look();
  }

  tools() {
    const tool = (title, drawn, act, props = {}) => button("", act, { icon: drawn, title, "aria-label": title, ...props });
    this.follower = tool(say("Follow the drone"), "video", () => this.follow(!this.live.follows), { "aria-pressed": true });
    return el("div.map-tools", { role: "toolbar", "aria-label": say("Map tools") },
      tool(say("Whole site"), "fit", () => { if (this.data.detail.bounds_wgs84) this.view.go(this.data.detail.bounds_wgs84); this.follow(false); }), this.follower,
      Object.entries(TOOLS).filter(([name]) => name !== "share").map(([name, [words_, , drawn]]) => tool(words_, drawn, () => (this.shown === name ? this.open(this.room) : this.open(name, true)), { data: { panel: name } })));
  }

  /** Keep the drone in the middle of the map, until somebody moves it. */
  follow(on) {
    if (!this.view || !this.live || this.live.follows === on) return;
    this.live.follows = on;
    press([this.follower], () => on);
    if (on) this.live.drawSoon();
  }

  /** Hear events while the screen is shown, or while something in it is. */
  hear(target, type, listener, { signal } = this.over) {
    target.addEventListener(type, listener, { signal });
  }

  /** Hear the station's events of this site: `listener(data, event)`. */
  on(type, listener, during = this.over) {
    this.hear(this.station.events, type, ({ detail }) => { if (detail.site === this.data.id) listener(detail.data ?? {}, detail); }, during);
  }

  /** A vote that the station does not take: what it has is shown again. Gives a button that shows what it was of. */
  refused(vote) {
    const found = vote.site === this.data.id && this.data.find(vote.id);
    if (!found) return null;
    this.data.load([vote.kind === "change" ? "changes" : "objects"]).catch(() => {});
    return button(say("Show it"), () => (this.opened?.see ? this.opened.see(found) : this.data.choose(found)));
  }

  async load() {
    const isNew = this.data.detail.is_new;
    const drawn = this.view?.ready.then(() => {
      if (this.closed) return;
      this.view.showNewest(this.data.detail);
      this.view.showUnderTrees(this.data.detail.under_trees);
      showStationMap(this);
      if (!this.lastPlace) {
        if (this.data.detail.bounds_wgs84 && this.view.covered().low) this.view.go(this.data.detail.bounds_wgs84, 0, true); // what a sheet lies over
        return;
      }
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
      this.loaded = "yes";
      this.data.isOld = kept.answers > before;
    } catch (problem) {
      this.loaded = "failed";
      throw problem;
    } finally { this.tell(); }
  }

  async loadRuns() {
    const asked = this.asked = get(`/api/runs?site=${encodeURIComponent(this.data.id)}`);
    const runs = await asked;
    if (asked !== this.asked) return this.asked; // an older answer that came later
    this.runs = runs;
    this.opened?.running?.();
    this.video?.look();
    this.tell();
  }

  /** The station's own state: its disk, who is logged in; and what could not be loaded is tried again. */
  async look() {
    try {
      this.station.status = { ...this.station.status, ...await get(`/api/status?site=${encodeURIComponent(this.data.id)}`) };
      sendDrawings(this);
      const others = this.station.status.present.filter((name) => name !== this.station.status.name);
      fill(this.people, others.length ? say("also here: {names}", { names: others.map(words.nameOf).join(", ") }) : "");
      if (this.closed || this.station.events.state !== "live") return;
      if (this.station.status.name !== votes.who) location.reload(); // another tab changed it
      if (this.loaded === "failed" || this.data.isOld) await this.reload();
    } catch { /* the sentence states it */ }
  }

  /** What was judged goes into what the service worker keeps, too: a reload without the station shows it. */
  renew() {
    if (!navigator.serviceWorker?.controller) return;
    clearTimeout(this.renewing);
    this.renewing = setTimeout(() => { for (const name of ["objects", "changes"]) this.data.ask(name).catch(() => {}); }, RENEW_MS);
  }

  /** State what is known, in a sentence whose parts lead to it. */
  tell() {
    if (this.closed) return;
    const { status, events } = this.station;
    const { objects, changes, pod } = this.data.all;
    const parts = sentence({ link: events.state === "live" && this.data.isOld ? "late" : events.state, loaded: this.loaded, runs: this.runs, objects, changes, pod, versions: this.data.detail.versions, drones: this.video?.here ?? [], votes: votes.mine.length, now: now(),
      isLow: status.disk_free_gb < 2 * status.disk_floor_gb, isFull: status.disk_free_gb < status.disk_floor_gb });
    const text = JSON.stringify(parts);
    if (text === this.told) return;
    this.told = text;
    this.known.dataset.loaded = this.loaded;
    const acts = { live: () => this.open("live", true), review: () => this.open("findings", true), compare: () => this.open("compare", true), coverage: () => { this.view?.show("pod", true); this.open("layers", true); } };
    fill(this.known, parts.map(({ words: said, act, kind }, k) => [k ? " · " : null, act ? button(said, acts[act], { class: `link ${kind}` }) : el("span", { class: kind }, said)]));
  }

  async reload({ type, data } = {}) {
    try {
      // its first mission failed, or the records of its missions go because it does
      const isHere = !(this.data.detail.is_new || type === "run.deleted") || await isMade(this.data.id);
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
        if (!this.opened?.versions) this.view.showNewest(this.data.detail);
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
      if (this.loaded === "failed") await this.reload();
    } catch (problem) { this.lost(problem); }
  }

  /** Whether an answer means that there is no such site, which ends the screen of one that was there. */
  lost({ status }) {
    if (status !== 404 && status !== 410) return false;
    if (!this.closed) this.gone();
    return true;
  }

  gone() {
    message(say("This site is gone"), { kind: "error", todo: say("Somebody deleted it. The list of sites shows the others.") });
    location.hash = "#/";
  }

  /** Open a room, or a tool beside the map, by its name. */
  open(name, byHand = false) {
    const shown = name in ALL_PANELS ? name : "live";
    this.opened?.close?.();
    this.shown = shown;
    if (shown in ROOMS) this.room = shown;
    press([...this.tabs, ...this.stage.querySelectorAll(".map-tools [data-panel]")], (each) => each.dataset.panel === shown);
    this.stage.dataset.panel = document.body.dataset.panel = shown;
    const [words_, made] = ALL_PANELS[shown];
    const body = el("div", { class: `body ${shown}` });
    fill(this.panel, el("div.panel-head", button("", () => this.resize(), { class: "quiet handle", "aria-label": say("More or less of this sheet") }), el("h2", words_),
      shown in TOOLS ? quiet(say("Close"), () => this.open(this.room), { icon: "close" }) : null), body);
    this.panel.setAttribute("aria-label", words_);
    if (byHand && this.panel.dataset.stop === "peek") this.resize("half");
    this.opened = new made(this, body);
    this.card.show(this.data.chosen);
    history.replaceState(null, "", roomUrl(this.data.id, shown));
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
    this.data.choose(found || null);
    if (found || this.data.detail.is_new) return;
    if (this.shown !== "place") this.open("place");
    this.opened.look?.(place, hits);
  }

  moved(place, hits) {
    fill(this.readout, words.place(place, { local: this.data.detail.is_local }));
    this.view.map.getCanvas().style.cursor = this.opened?.cursor ?? (hits.length ? "pointer" : "");
    this.opened?.move?.(place);
  }

  draw(names) {
    if (names.includes("detail")) this.name();
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
    this.view?.put("chosen", chosen ? [chosen, featureOf("Point", middleOf(chosen.geometry))] : []);
    this.card.show(chosen);
    this.opened?.chosen?.(chosen);
  }

  redraw() {
    this.card.show(this.data.chosen);
    this.opened?.refresh?.();
  }

  goTo(feature) {
    const middle = middleOf(feature.geometry);
    this.follow(false);
    if (middle) this.view?.go(middle);
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest?.("input:not([type=range], [type=checkbox]), select, textarea, dialog")) return;
    if (this.opened?.key?.(event)) return event.preventDefault();
    const name = Object.keys(ALL_PANELS)[Number(event.key) - 1];
    if (name) this.open(name, true);
    else if (event.key.toLowerCase() === "f") this.follow(!this.live.follows);
    else if (event.key === "Escape") {
      if (this.data.chosen) this.data.choose(null);
      else if (this.shown in TOOLS) this.open(this.room);
      else if (JSON.stringify(this.data.filters) !== JSON.stringify(ALL)) this.data.filter(ALL);
    }
  }

  close() {
    this.closed = true;
    clearTimeout(this.renewing);
    this.opened?.close?.();
    this.live.close();
    this.video.close();
    this.data.close();
    this.over.abort();
    this.timers.forEach(clearInterval);
    delete document.body.dataset.panel;
    this.view?.close();
  }
}
