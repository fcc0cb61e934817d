// The running flight: the drone on the map, its track, tiles that change, figures at a glance, zones that raise an alert.

import { get } from "./api.js";
import { choices } from "./choices.js";
import { button, el, fill, message } from "./dom.js";
import { inRing, middleOf } from "./places.js";
import { titleOf } from "./feature_card.js";
import * as words from "./words.js";

const STATUS_MS = 10000;
const RATE_WINDOW_MS = 10000;
const PLACED_FOR_MS = 3000; // a frame's place counts for so long before telemetry alone is shown
const CLOCKS_AGREE_S = 0.5;
const LONGEST_DELAY_S = 600; // more is a recording, or a clock that is wrong

/** Follow the site's live events; `show` draws the figures anew, `close` ends it. */
export function followLive(screen) {
  return new Live(screen);
}

class Live {
  constructor(screen) {
    Object.assign(this, { screen, flown: new Map(), ends: [], alerted: new Set(), follows: false });
    const on = (type, listener) => {
      const mine = ({ detail }) => { if (detail.site === screen.data.id) listener(detail.data ?? {}, detail); };
      screen.station.events.addEventListener(type, mine);
      this.ends.push(() => screen.station.events.removeEventListener(type, mine));
    };
    on("map.tiles", (data) => screen.view?.ready.then(() => this.refresh(data)));
    on("coverage.changed", () => this.coverSoon());
    on("frame.placed", (data, event) => this.placed(data, event));
    on("run.started", (data, event) => this.started(data, event));
    on("run.progress", (data, event) => this.progressed(data, event));
    for (const type of ["run.finished", "run.failed", "run.stopped"]) on(type, (data, event) => this.ended(type, data, event));
    on("object.found", ({ feature }, event) => this.found("objects", watched(feature, event.run)));
    on("person.found", ({ feature, is_local: local }, event) => this.person(feature, local, event.run));
    on("change.announced", ({ feature }) => this.found("changes", feature));
    on("change.withdrawn", ({ feature, id }) => screen.data.drop("changes", feature?.id ?? id));
    this.timer = setInterval(() => this.look(), STATUS_MS);
    this.show();
  }

  refresh({ revision, bounds }) {
    if (this.screen.closed || !this.screen.view) return;
    const data = this.screen.data;
    if (!data.detail.bounds_wgs84 && bounds) {
      data.detail.bounds_wgs84 = bounds;
      this.screen.view.go(bounds);
      this.screen.opened?.refresh?.();
    }
    if (!this.screen.opened?.versions) this.screen.view.refresh(revision, bounds);
  }

  /** Load the holes of the flight in the air anew, once at a time. */
  async coverSoon() {
    if (this.covering) { this.coversAgain = true; return; }
    this.covering = true;
    try {
      do {
        this.coversAgain = false;
        await this.screen.data.load(["coverage"]);
      } while (this.coversAgain && !this.screen.closed);
    } catch { /* the connection's own sign shows it; the next change loads it */ } finally { this.covering = false; }
  }

  /** What a running mission has reported so far. */
  of(run) {
    if (!this.flown.has(run)) this.flown.set(run, { trail: [], places: [], progress: null, statuses: {}, reasons: {} });
    return this.flown.get(run);
  }

  /** The mission whose figures and track are shown: where several run, one that places frames by their pictures. */
  get shown() {
    const all = [...this.flown.values()];
    return all.find((each) => each.progress?.selected !== undefined) ?? all.at(-1);
  }

  started(_, event) {
    this.flown.delete(event.run);
    this.of(event.run);
    this.show();
  }

  progressed(data, event) {
    const run = this.of(event.run);
    run.progress = data;
    if (data.reason) run.reasons[data.reason] = (run.reasons[data.reason] ?? 0) + 1;
    this.show();
  }

  placed(data, event) {
    const run = this.of(event.run);
    const { position } = data;
    run.places.push(Date.now());
    run.statuses[data.status] = (run.statuses[data.status] ?? 0) + 1;
    const delay_s = (new Date(event.at) - new Date(data.time)) / 1000;
    // a recorded flight has none, and a drone whose clock is ahead of the station's has none that is known
    run.delay_s = delay_s > -CLOCKS_AGREE_S && delay_s < LONGEST_DELAY_S ? Math.max(0, delay_s) : undefined;
    if (position) run.trail.push(position.slice(0, 2));
    if (run !== this.shown) return;
    this.last = data;
    const { view, data: site } = this.screen;
    if (position && view && !site.detail.bounds_wgs84 && run.trail.length === 1) view.go(position.slice(0, 2), 18);
    this.drawSoon();
  }

  /** What a streaming drone states of itself; a mission places it better. */
  heard(telemetry) {
    this.telemetry = telemetry;
    const { latitude_deg: lat, longitude_deg: lon, camera_yaw_deg: camera, body_yaw_deg: body } = telemetry ?? {};
    if (lat !== undefined && Date.now() - (this.shown?.places.at(-1) ?? 0) > PLACED_FOR_MS) {
      this.last = { position: [lon, lat], heading_deg: body ?? camera ?? 0 };
      this.drawSoon();
    } else this.show();
  }

  /** Draw at most once for each picture of the screen, however many frames came. */
  drawSoon() {
    this.drawing ??= requestAnimationFrame(() => {
      this.drawing = null;
      this.draw();
      this.show();
    });
  }

  draw() {
    const { view, data } = this.screen;
    if (!view || this.screen.closed || !this.last) return;
    view.put("drone", droneFeatures(this.last));
    const trail = this.shown?.trail ?? [];
    const line = trail.length > 1 ? [{ type: "Feature", properties: { live: true }, geometry: { type: "LineString", coordinates: trail } }] : [];
    view.put("track", [...data.all.track, ...line]);
    if (this.follows && this.last.position) view.go(this.last.position.slice(0, 2), view.map.getZoom());
  }

  found(name, feature) {
    if (!feature) return;
    feature.id ??= feature.properties.id;
    this.screen.data.take(name, feature);
    const middle = middleOf(feature.geometry);
    for (const zone of this.screen.zones ?? []) {
      if (zone.properties.purpose !== "alert" || this.alerted.has(feature.id) || !inRing(middle, zone.geometry.coordinates[0])) continue;
      this.alerted.add(feature.id);
      this.alert(zone, feature);
    }
  }

  alert(zone, feature) {
    message(`${zone.properties.name || "Alert zone"}: ${titleOf(feature)}`, { kind: "alert", todo: words.place(middleOf(feature.geometry)),
      act: button("Show", () => { this.screen.data.choose(feature); this.screen.goTo(feature); }) });
    if (choices.get("sound")) beep();
  }

  /** A person was found, by whatever mission: one banner a mission, which stays until it is closed. */
  person(feature, local, run) {
    const mission = this.of(run);
    mission.people = (mission.people ?? 0) + 1;
    mission.banner?.remove();
    const many = mission.people > 1 ? `${mission.people} people found, the last: ` : "Person found: ";
    const place = local || !feature.geometry ? "without a place on Earth" : words.place(middleOf(feature.geometry));
    mission.banner = message(many + titleOf(feature), { kind: "alert person", todo: place,
      act: local || !feature.geometry ? null : button("Show", () => this.screen.goTo(feature)) });
    if (choices.get("sound")) beep();
  }

  ended(type, data, event) {
    this.flown.delete(event.run);
    if (!this.flown.size) {
      this.last = null;
      this.screen.view?.put("drone", []);
    }
    this.show();
    if (type === "run.failed") message("The mission failed", { kind: "error", todo: data.error || data.headline || "See “Missions” for why." });
    else if (data.state === "incomplete") message("Check this result before you use it", { kind: "warning", todo: data.headline });
    else message(data.headline || "The mission is done");
  }

  /** Figures of the mission that runs. */
  ofRun(run) {
    const { matched, selected, frames_per_second: rate, latency_s: delay_s } = run.progress ?? {};
    const by_gps = run.statuses["gps-only"] ?? 0;
    return { matched, by_gps, rejected: selected === undefined ? undefined : Math.max(0, selected - matched - by_gps), reasons: run.reasons,
      rate: rate ?? rateOf(run), delay_s: delay_s ?? run.delay_s };
  }

  /** Figures of all flights of the site. */
  ofSite() {
    const flights = this.screen.data.detail.flights ?? [];
    const sum = (name) => flights.reduce((total, each) => total + each[name], 0);
    const reasons = {};
    for (const each of flights) for (const [why, count] of Object.entries(each.reasons)) reasons[why] = (reasons[why] ?? 0) + count;
    return { matched: sum("matched"), by_gps: sum("by_gps"), rejected: sum("rejected"), reasons };
  }

  async look() {
    try {
      this.screen.station.status = { ...this.screen.station.status, ...await get("/api/status") };
    } catch { /* the connection's own sign shows it */ }
    if (!this.screen.closed) this.show();
  }

  show() {
    const status = this.screen.station.status;
    const run = this.shown;
    const figures = run ? this.ofRun(run) : this.ofSite();
    const low = status.disk_floor_gb !== undefined && status.disk_free_gb < 2 * status.disk_floor_gb;
    const rows = [
      run && ["frames/s", words.number(figures.rate), "Frames that the mission takes in a second"],
      run && ["latency", figures.delay_s === undefined ? "–" : `${words.number(figures.delay_s, 2)} s`, "From the drone's picture to its place on the map"],
      ["matched", words.number(figures.matched, 0), "Frames placed by vision"],
      ["by GPS", words.number(figures.by_gps, 0), "Frames placed by GPS alone"],
      this.telemetry && ["GPS", this.telemetry.horizontal_sigma_m === undefined ? "on" : words.length(this.telemetry.horizontal_sigma_m), gpsWords(this.telemetry)],
      ["rejected", words.number(figures.rejected, 0), Object.entries(figures.reasons).map(([why, count]) => `${count} × ${why}`).join("\n") || "None"],
      ["memory", status.memory_mb ? words.bytes(status.memory_mb * 1e6) : "–", "Of the station's process"],
      ["disk left", words.bytes(status.disk_free_gb * 1e9), low ? "Nearly full: free some space, or nothing new is taken in" : "Free space where the sites are"],
    ];
    fill(this.screen.numbers, rows.filter(Boolean).map(([name, value, why]) =>
      el("button", { type: "button", class: `figure${name === "disk left" && low ? " low" : ""}`, title: why, on: { click: () => message(`${name}: ${value}`, { todo: why }) } },
        el("b", {}, value), el("span", {}, name))));
  }

  close() {
    clearInterval(this.timer);
    cancelAnimationFrame(this.drawing);
    for (const end of this.ends) end();
  }
}

/** Frames a second over the last seconds, as they came to this page. */
function rateOf(run) {
  const since = Date.now() - RATE_WINDOW_MS;
  run.places = run.places.filter((each) => each > since);
  return run.places.length / (RATE_WINDOW_MS / 1000);
}

/** An object that a watch reported: it stands on no map, so its id is the mission's own. */
function watched(feature, run) {
  if (!feature?.geometry) return null;
  const id = `${run}:${feature.id ?? feature.properties.id}`;
  return { ...feature, id, properties: { ...feature.properties, id, watched: true } };
}

/** What is drawn of the drone: itself, the ground in its picture, and the lines of sight to that ground's corners. */
function droneFeatures({ position, footprint, heading_deg: heading }) {
  const features = [];
  const ring = footprint?.coordinates?.[0] ?? footprint;
  const add = (part, geometry, more = {}) => features.push({ type: "Feature", properties: { part, ...more }, geometry });
  if (Array.isArray(ring) && ring.length > 3) {
    const closed = String(ring[0]) === String(ring.at(-1)) ? ring : [...ring, ring[0]];
    add("footprint", { type: "Polygon", coordinates: [closed] });
    if (position) add("view", { type: "MultiLineString", coordinates: closed.slice(0, 4).map((corner) => [position.slice(0, 2), corner.slice(0, 2)]) });
  }
  if (position) add("body", { type: "Point", coordinates: position.slice(0, 2) }, { heading_deg: heading ?? 0 });
  return features;
}

function gpsWords({ horizontal_sigma_m: sigma, speed_m_s: speed, height_above_takeoff_m: height }) {
  return [sigma === undefined ? "The drone states no accuracy" : `Standard deviation of a fix ${words.length(sigma)}`,
    speed === undefined ? null : `speed ${words.speed(speed)}`, height === undefined ? null : `${words.length(height)} above take-off`].filter(Boolean).join("\n");
}

let sound = null;

function beep() {
  try {
    sound ??= new AudioContext();
    const tone = sound.createOscillator();
    const loud = sound.createGain();
    loud.gain.value = 0.12;
    tone.frequency.value = 880;
    tone.connect(loud).connect(sound.destination);
    tone.start();
    tone.stop(sound.currentTime + 0.25);
  } catch { /* a browser without sound shows the message alone */ }
}
